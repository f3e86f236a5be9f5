# SPDX-License-Identifier: GPL-3.0-or-later
"""Measure speed against error: ``python -m benchmarks.speed_vs_error``.

Presets and meshers on photos of scenes whose surface is known exactly (``benchmarks/scenes``), each
through the command line as a user would run it. Each run leaves a record in
``benchmarks/records/speed``; a run that has one is not made again, so that the study may take
several sittings: stop the command whenever you like. At the end, or with ``--document``,
``docs/benchmarks/speed-vs-error.md`` and its plot are written from the records alone;
``--pictures`` draws the runs that this machine has kept.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from gaussian_wrapping_addon.core.evaluation.mesh_rendering import BACKGROUND, TexturedRenderer
from gaussian_wrapping_addon.core.evaluation.surface_scores import read_truth
from gaussian_wrapping_addon.core.files import read_json
from gaussian_wrapping_addon.core.mesh.depth_buffer import depth_buffer
from gaussian_wrapping_addon.core.mesh.sampling import distances_to_mesh
from gaussian_wrapping_addon.core.scene.camera import Camera
from gaussian_wrapping_addon.core.scene.scene import load_saved_scene

from .alpha_shape import make_alpha
from .plots import Panel, Series, write_svg
from .provenance import write_page
from .runs import PRESETS, THRESHOLD_SHARES
from .scenes.cache import ensure_scene
from .score import read_textured, stage_folder, test_views
from .study import (
    KEPT_RUNS,
    MBR_NOTE,
    PHOTOS,
    Case,
    Record,
    commits,
    f1_fine,
    f1_middle,
    f1_seen,
    gaussians,
    made_by,
    make,
    mbr_psnr,
    normal_error,
    photos_said,
    reading,
    run_folder,
    run_study,
    texture_psnr,
    thin,
    view_psnr,
)
from .tables import AT, SHARES, Row, Table, table_of, three, two

STUDY = "speed"
SCENES = ("wheel", "spot", "fence", "room")
MESHED_PRESETS = ("standard",)
"""Whose trainings every mesher gets: differences between meshers hardly depend on the training
(benchmarks/meshing.py)."""
ALPHA = "alpha"
"""The alpha shape of the sparse points: what is there before anything is trained."""

ADAPTIVE, UNIFORM, TWO, NINE = "adaptive", "uniform", "pivots2", "pivots9"
_CHEAP_TEXTURE = ("--texture-size", "64")
"""The textures of further meshes are not looked at."""
MESHERS = {
    UNIFORM: ("--spacing", "uniform", *_CHEAP_TEXTURE),
    TWO: ("--method", "pivots", "--pivots", "2", "--pivot-samples", "none", *_CHEAP_TEXTURE),
    NINE: ("--method", "pivots", "--pivots", "9", "--pivot-samples", "none", *_CHEAP_TEXTURE),
}
"""Besides the default, which is that of the presets: primal adaptive meshing, adaptive spacing."""

LABELS = {
    ALPHA: "alpha shape of the sparse points",
    ADAPTIVE: "primal adaptive, adaptive spacing (default)",
    UNIFORM: "primal adaptive, uniform spacing",
    TWO: "marching tetrahedra, 2 pivots",
    NINE: "marching tetrahedra, 9 pivots",
}


def preset_case(scene: str, preset: str) -> Case:
    """Return the run of a preset as it is."""
    return Case(STUDY, scene, preset, 0, preset, ())


def mesher_case(scene: str, preset: str, mesher: str) -> Case:
    """Return another mesh of a preset's training."""
    base = preset_case(scene, preset)
    return Case(STUDY, scene, f"{preset}_{mesher}", 0, preset, MESHERS[mesher], base.identity)


def alpha_case(scene: str) -> Case:
    """Return the alpha shape of a scene's sparse points."""
    return Case(STUDY, scene, ALPHA, 0, "", ())


def study_plan() -> list[Case]:
    """Return all runs in the order in which they are made."""
    cheap = [alpha_case(scene) for scene in SCENES]
    trained = []
    for preset in PRESETS:
        for scene in SCENES:
            trained.append(preset_case(scene, preset))
            if preset in MESHED_PRESETS:
                trained += [mesher_case(scene, preset, mesher) for mesher in MESHERS]
    return [*cheap, *trained]


Records = Mapping[str, Record]
"""By identity."""


def preset_table(records: Records) -> Table:
    """Return processor time and error of the presets, after the trivial surface of each scene."""
    rows: list[Row] = []
    knows_mbr = any(mbr_psnr(r) is not None for r in records.values())
    for scene in SCENES:
        for case in (alpha_case(scene), *(preset_case(scene, p) for p in PRESETS)):
            r = records.get(case.identity)
            if r is None:
                continue
            trivial = case.name == ALPHA
            rows.append(
                {
                    "scene": scene,
                    "preset": "alpha shape" if trivial else case.preset,
                    "processor s": _seconds(r.spent_s),
                    "training": None if trivial else _seconds(r.processor("train")),
                    "mesh": None if trivial else _seconds(r.processor("mesh")),
                    "texture": None if trivial else _seconds(r.processor("texture")),
                    "peak GiB": None if r.memory_gib is None else f"{r.memory_gib:.2f}",
                    "Gaussians": gaussians(r),
                    "vertices": r.mesh["vertices"],
                    **_errors(r),
                    f"seen F1 {AT}": three(f1_seen(r)),
                    "test views dB": two(view_psnr(r)),
                    "textured mesh dB": two(texture_psnr(r)),
                    **({"MBR dB": two(mbr_psnr(r))} if knows_mbr else {}),
                    "closed": _closed(r),
                }
            )
    return table_of(
        "Presets",
        rows,
        "Processor s: seconds of all threads, of all stages of the job together and of three of "
        "them; starting Python is not among them, and kernels were compiled before.",
        "F1 at shares of the crop volume's diagonal, whole surface, hidden sides included; seen "
        "F1: what the cameras see of both surfaces. Thin recall: true samples on parts thinner "
        "than 1.5 % of the diagonal that at least two cameras see, where at least 1 % of the "
        "samples are thin. Normal error: one less the mean size of the cosine between normals of "
        "counterparts, both directions.",
        "Test views: PSNR of the Gaussians at eight views that the job was never given, whole "
        "photo. Textured mesh: PSNR on the pixels that show the true surface; a hole is an error "
        "there." + (f" {MBR_NOTE}" if knows_mbr else ""),
        "Alpha shape: of the sparse points that training starts from, with the best alpha of six "
        "by the truth; its time is that of the triangulation alone. What is not above it was not "
        "worth training for.",
    )


def mesher_table(records: Records) -> Table:
    """Return every mesh of a training, the preset's own first."""
    rows: list[Row] = []
    knows_mbr = any(mbr_psnr(r) is not None for r in records.values())
    for scene in SCENES:
        for preset in MESHED_PRESETS:
            others = {m: mesher_case(scene, preset, m).identity for m in MESHERS}
            if not any(identity in records for identity in others.values()):
                continue
            for mesher, identity in {
                ADAPTIVE: preset_case(scene, preset).identity,
                **others,
            }.items():
                r = records.get(identity)
                if r is None:
                    continue
                rows.append(
                    {
                        "scene": scene,
                        "training": preset,
                        "mesher": LABELS[mesher],
                        "mesh, processor s": _seconds(r.processor("mesh")),
                        "vertices": r.mesh["vertices"],
                        "faces": r.mesh["faces"],
                        **_errors(r),
                        **({"MBR dB": two(mbr_psnr(r))} if knows_mbr else {}),
                        "components": r.mesh["components"],
                        "closed": _closed(r),
                    }
                )
    return table_of(
        "Meshers on the same training",
        rows,
        "Marching tetrahedra from the pivots alone, as in the paper, without samples of depth "
        "maps (`--pivot-samples none`).",
    )


def spent_s(record: Record, records: Records) -> float:
    """Return the processor seconds from photos to mesh; of a further mesh with its training."""
    own = record.processor("mesh")
    if record.case.name == ALPHA:
        return own
    trained = records.get(record.case.base) if record.case.base else record
    return math.nan if trained is None else own + trained.processor("cameras", "train")


def _errors(record: Record) -> Row:
    return {
        f"F1 {SHARES[0]}": three(f1_fine(record)),
        f"F1 {AT}": three(f1_middle(record)),
        f"F1 {SHARES[2]}": three(record.f1(2)),
        f"thin recall {AT}": three(thin(record)),
        "normal error": three(normal_error(record)),
    }


def _seconds(value: float) -> str | None:
    if not math.isfinite(value):
        return None
    return f"{value:.0f}" if value >= 10 else f"{value:.1f}"


def _closed(record: Record) -> str | None:
    closed = record.mesh["closed"]
    return None if closed is None else ("yes" if closed else "NO")


def write_plot(records: Records, path: Path) -> None:
    """Write one panel for each scene that has runs; error is one less F1."""
    panels = []
    for scene in SCENES:
        rows = {
            LABELS[ADAPTIVE]: [(p, preset_case(scene, p)) for p in PRESETS],
            **{LABELS[m]: [(p, mesher_case(scene, p, m)) for p in MESHED_PRESETS] for m in MESHERS},
            LABELS[ALPHA]: [("", alpha_case(scene))],
        }
        series = []
        for name, cases in rows.items():
            found = [(label, records[c.identity]) for label, c in cases if c.identity in records]
            if found:
                points = [(spent_s(r, records), 1.0 - f1_middle(r)) for _, r in found]
                labels = tuple(label for label, _ in found) if name == LABELS[ADAPTIVE] else ()
                series.append(Series(name, points, labels=labels))
        if series:
            panels.append(
                Panel(scene, "cameras, training and mesh, processor s", f"1 - F1 at {AT}", series)
            )
    write_svg(panels, path)


WIDTH_PX = 420
VIEW = 1
SUPERSAMPLING = 2
ERROR_COLORS = ((70, 120, 200), (110, 190, 110), (240, 200, 60), (200, 50, 40))
"""Nearer than each threshold of the report, and farther than all."""
NOT_JUDGED = (150, 150, 150)
"""Faces outside of the crop volume."""
LIGHT = np.array([-0.4, -0.5, -0.77])
"""Direction of light in camera coordinates, towards the scene."""
QUALITY = 85


def write_comparison(scene: Path, runs: Sequence[tuple[str, Path]], path: Path) -> None:
    """Write one JPEG: photo and textured meshes above, true surface and errors below.

    Parameters
    ----------
    scene : Path
        Ground truth.
    runs : sequence of (label, folder)
        Finished runs, each with ``mesh/`` and ``out/``.
    path : Path
        Where the picture goes.
    """
    truth = read_truth(scene)
    diagonal = float(read_json(scene / "scene.json")["diagonal"])
    top, bottom = [], []
    for label, folder in runs:
        frame = load_saved_scene(stage_folder(folder / "out", "cameras")).world_from_scene
        camera, photo = test_views(scene, frame.inverse())[VIEW]
        size = (WIDTH_PX, round(WIDTH_PX * camera.height / camera.width))
        textured = read_textured(folder / "mesh")
        if not top:
            top.append(("photo", np.asarray(Image.fromarray(photo).resize(size))))
            true = frame.inverse().points(truth.vertices)
            grey = np.full((len(truth.faces), 3), 200.0)
            bottom.append(("true surface", shade(true, truth.faces, grey, camera, size)))
        top.append((label, TexturedRenderer(textured).render(camera, size).image))
        mesh = textured.mesh
        centres = frame.points(mesh.vertices[mesh.faces].mean(1))
        distance = distances_to_mesh(centres, truth.vertices, truth.faces)[0] / diagonal
        colors = np.array(ERROR_COLORS, float)[np.searchsorted(THRESHOLD_SHARES, distance)]
        if truth.crop is not None:
            colors[~truth.crop.contains(centres)] = NOT_JUDGED
        bottom.append((f"{label}: error", shade(mesh.vertices, mesh.faces, colors, camera, size)))
    rows = [
        np.concatenate([_labelled(image, text) for text, image in row], 1) for row in (top, bottom)
    ]
    Image.fromarray(np.concatenate(rows)).save(path, quality=QUALITY)


def shade(
    vertices: np.ndarray,
    faces: np.ndarray,
    colors: np.ndarray,
    camera: Camera,
    size: tuple[int, int],
) -> np.ndarray:
    """Return (h, w, 3) uint8: the mesh in (f, 3) face colours under one light."""
    width, height = size
    fine = camera.resized(SUPERSAMPLING * width, SUPERSAMPLING * height)
    faces = np.ascontiguousarray(faces, np.int32)
    hit = depth_buffer(vertices, faces, fine, threads=2).face  # (h, w)
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    light = (LIGHT / np.linalg.norm(LIGHT)) @ camera.rotation
    bright = 0.45 + 0.55 * np.abs(normals @ light)  # (f,)
    lit = np.vstack([colors * bright[:, None], BACKGROUND])  # the last row serves hit = -1
    image = lit[hit].reshape(height, SUPERSAMPLING, width, SUPERSAMPLING, 3).mean((1, 3))
    return np.round(image).clip(0, 255).astype(np.uint8)


def _labelled(image: np.ndarray, text: str) -> np.ndarray:
    picture = Image.fromarray(image)
    draw = ImageDraw.Draw(picture)
    draw.rectangle((0, 0, 8 + 7 * len(text), 18), fill=(0, 0, 0))
    draw.text((5, 3), text, fill=(255, 255, 255))
    return np.asarray(picture)


PAGE, PLOT = "speed-vs-error.md", "speed-vs-error.svg"
COMMAND = "python -m benchmarks.speed_vs_error"


def write_document(out: Path, records: Records, cases: Sequence[Case]) -> Path:
    """Write page and plot into a folder; reading and pictures lie beside them."""
    write_plot(records, out / PLOT)
    tables = (preset_table(records), mesher_table(records))
    lines = [
        *made_by(COMMAND, list(records.values()), cases),
        "",
        photos_said(PHOTOS),
        "Presets as they are (Draft trains at 480 pixels, the others at 640), the model selected",
        "from the photos, every 8th photo held out; seed 0.",
        "",
        f"![Processor seconds against error]({PLOT})",
        "",
        *reading("speed-vs-error"),
        *(table.markdown() for table in tables[:1] if table.rows),
        *_pictures(out),
        *(table.markdown() for table in tables[1:] if table.rows),
        *reading("protocol"),
    ]
    return write_page(out / PAGE, "Speed against error", commits(records.values()), lines)


def picture(scene: str) -> str:
    """Return the name of the picture of a scene."""
    return f"scene-{scene}.jpg"


def _pictures(out: Path) -> list[str]:
    """Return the pictures that were drawn, with what they show."""
    names = {scene: picture(scene) for scene in SCENES if (out / picture(scene)).is_file()}
    if not names:
        return []
    return [
        "### What it looks like",
        "",
        "Above: a test photo and the textured meshes. Below: the true surface, and the meshes",
        "coloured by the distance of each face's centre to it: blue within 0.25 % of the diagonal,",
        "green within 0.5 %, yellow within 1 %, red beyond; grey is not judged.",
        "",
        *(line for scene, name in names.items() for line in (f"![{scene}]({name})", "")),
    ]


def main(arguments: Sequence[str] | None = None) -> int:
    """Do what the command line asks for; return 1 where a run failed, else 0."""
    return run_study(arguments, __doc__, study_plan(), write_document, make_one, draw_pictures)


def make_one(case: Case, *, threads: int, kept: Path = KEPT_RUNS) -> Record:
    """Make a preset, another mesh of it, or the alpha shape."""
    maker = make_alpha if case.name == ALPHA else make
    return maker(case, threads=threads, kept=kept)


def draw_pictures(out: Path) -> None:
    """Draw the presets of each scene side by side, as far as their runs are kept."""
    for scene in SCENES:
        folders = [(p, run_folder(preset_case(scene, p))) for p in PRESETS]
        kept = [(label, folder) for label, folder in folders if (folder / "mesh").is_dir()]
        if kept:
            truth = ensure_scene(
                scene, photos=PHOTOS.count, width=PHOTOS.width, height=PHOTOS.height
            )
            write_comparison(truth, kept, out / picture(scene))


if __name__ == "__main__":
    raise SystemExit(main())
