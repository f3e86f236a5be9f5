# SPDX-License-Identifier: GPL-3.0-or-later
"""Measure unwrap and bake: ``python -m benchmarks.texturing``.

Photos of spot with a known texture are rendered by rays and baked back; then a mesh of 375 thousand
faces is unwrapped and baked at 4096 x 4096 from 40 photos of 2 megapixels, in a process of its own.
With ``--jobs`` finished jobs of real photos are textured without their held-out photos and compared
with these, and so are true meshes of the zoo's glossy scenes with its test views. A page
and its pictures go into ``docs/benchmarks``, the figures into ``benchmarks/records``.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import logging
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gaussian_wrapping_addon.core.evaluation.mesh_based_rendering import bake_held_out_texture
from gaussian_wrapping_addon.core.evaluation.mesh_rendering import TexturedRenderer, render_views
from gaussian_wrapping_addon.core.evaluation.photo_views import write_side_by_side
from gaussian_wrapping_addon.core.evaluation.surface_scores import read_truth
from gaussian_wrapping_addon.core.files import read_json
from gaussian_wrapping_addon.core.limits import MAX_IMAGE_SIDE_PX
from gaussian_wrapping_addon.core.loading.load import load_scene
from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh, load_mesh
from gaussian_wrapping_addon.core.mesh.textured_mesh import TexturedMesh
from gaussian_wrapping_addon.core.photos.store import PhotoStore
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.scene.camera import Camera
from gaussian_wrapping_addon.core.scene.scene import load_saved_scene
from gaussian_wrapping_addon.core.settings import TextureSettings
from gaussian_wrapping_addon.core.texture.atlas import raster_atlas
from gaussian_wrapping_addon.core.texture.texture_mesh import texture_mesh

from .known_texture import (
    RenderedPhotos,
    SolidTexture,
    Unevenness,
    cameras_around,
    photograph,
    photos_that_see,
    psnr,
    seams,
    spot,
    steps_between_texels,
    true_albedo,
    uneven,
)
from .provenance import (
    DOCUMENTS,
    RECORDS,
    code_of_tree,
    read_figures,
    said_origin,
    write_figures,
    write_page,
)
from .score import test_views
from .zoo.scene import ensure_zoo_scene

PICTURE_WIDTH_PX = 1400


def compared(
    textured: TexturedMesh,
    cameras: Sequence[Camera],
    photos: Sequence[np.ndarray],
    picture: Path | None,
    threads: int,
) -> dict[str, float]:
    """Compare renderings with photos, over the pixels that the mesh covers wholly.

    Parameters
    ----------
    picture : Path or None
        Gets the photo of median PSNR, left, and the rendering, right.

    Returns
    -------
    dict
        Means over the photos: ``psnr``, ``ssim``, ``covered``, and ``fitted_psnr``, with one gain
        a channel fitted to each photo; ``views``: number of photos compared.
    """
    shown: dict[str, tuple[np.ndarray, np.ndarray]] = {}

    def keep(name: str, photo: np.ndarray, image: np.ndarray) -> None:
        shown[name] = photo, image

    score = render_views(textured, list(cameras), list(photos), threads=threads, on_view=keep)
    renderer = TexturedRenderer(textured, threads=threads)
    fitted = [
        _fitted_psnr(*shown[camera.name], renderer.render(camera).covered)
        for camera in cameras
        if camera.name in shown
    ]
    if picture is not None:
        ranked = sorted(score.views, key=lambda view: view.scores.psnr)
        middle = ranked[len(ranked) // 2].name
        write_side_by_side(picture, *shown[middle], max_width_px=PICTURE_WIDTH_PX)
    return {
        "psnr": score.mean("psnr"),
        "fitted_psnr": float(np.mean(fitted)),
        "ssim": score.mean("ssim"),
        "covered": score.mean("covered"),
        "views": len(score.views),
    }


def _fitted_psnr(photo: np.ndarray, image: np.ndarray, covered: np.ndarray) -> float:
    """Return the PSNR over covered pixels with the best gain of each channel, dB."""
    a, b = image[covered].astype(np.float64), photo[covered].astype(np.float64)
    gain = (a * b).sum(0) / np.maximum((a * a).sum(0), 1e-9)
    error = np.clip(gain * a, 0, 255) - b
    return float(10 * np.log10(255.0**2 / max(float((error**2).mean()), 1e-9)))


LONG_SIDE_PX = 800


def held_out_figures(job: Path, picture: Path | None, threads: int) -> dict[str, Any]:
    """Texture a finished job's mesh anew without its held-out photos, and compare with these.

    Parameters
    ----------
    job : Path
        A job folder; the region that was meshed last counts.
    picture : Path or None
        Gets the photo of median PSNR, left, and the rendering, right.

    Returns
    -------
    dict
        What :func:`compared` returns; ``fitted_psnr`` counts, since nobody knows the
        exposure of a photo that was held out. ``itself_psnr``: of a texture baked from the held-out
        photos alone, about as much as one unlit texture can have.
    """
    scene = load_saved_scene(_newest(job, "cameras"))
    trained = read_json(_newest(job, "train") / "done.json")
    names = {figure["name"] for figure in trained["held_out"]}
    mesh = load_mesh(_newest(job, "mesh") / "mesh.npz")
    seen = tuple(view for view in scene.views if view.camera.name not in names)
    kept = dataclasses.replace(scene, views=seen)
    with tempfile.TemporaryDirectory() as folder:
        textured = texture_mesh(
            mesh, kept, PhotoStore(kept, MAX_IMAGE_SIDE_PX), TextureSettings(), Path(folder),
            Progress(), threads=threads,
        )  # fmt: skip
    photos = PhotoStore(scene, MAX_IMAGE_SIDE_PX)
    cameras, images = [], []
    for index, view in enumerate(scene.views):
        if view.camera.name in names:
            full = photos.camera(index, 1)
            divisor = -(-max(full.width, full.height) // LONG_SIDE_PX)
            cameras.append(photos.camera(index, divisor))
            images.append(photos.photo(index, divisor))
    figures = compared(textured, cameras, images, picture, threads)
    with tempfile.TemporaryDirectory() as folder:
        # On the same UVs, from the photos that it is compared with.
        itself = bake_held_out_texture(
            textured, scene, photos, [view.camera.name for view in seen], 1, Path(folder),
            Progress(), threads=threads,
        )  # fmt: skip
    return {
        "photos": len(seen),
        "faces": len(mesh.faces),
        "texture": textured.statistics,
        "itself_psnr": compared(itself, cameras, images, None, threads)["psnr"],
        **figures,
    }


def _newest(job: Path, name: str) -> Path:
    """Return the folder of the stage that finished last: a job may have been meshed again."""
    done = list((job / "stages").glob(f"{name}-*/done.json"))
    return max(done, key=lambda path: path.stat().st_mtime).parent


SCENES = ("gloss-d1", "gloss-d2", "gloss-d3")


def glossy_figures(name: str, picture: Path, threads: int) -> dict[str, Any]:
    """Texture the true mesh of a scene from its photos, and compare with its test views.

    Parameters
    ----------
    name : str
        Of a scene of the zoo; its photos are rendered where they are missing.
    picture : Path
        Gets the test view of median PSNR, left, and the rendering, right.

    Returns
    -------
    dict
        What :func:`compared` returns, ``photos`` and ``size_px``.
    """
    folder = ensure_zoo_scene(name, threads)
    truth = read_truth(folder).mesh
    assert truth is not None
    vertices, faces = truth
    with tempfile.TemporaryDirectory() as work:
        scene = load_scene(folder, Path(work), Progress())
        to_scene = scene.world_from_scene.inverse()
        mesh = SurfaceMesh(to_scene.points(vertices), np.asarray(faces, np.int32))
        textured = texture_mesh(
            mesh, scene, PhotoStore(scene, MAX_IMAGE_SIDE_PX), TextureSettings(), Path(work),
            Progress(), threads=threads,
        )  # fmt: skip
    views = test_views(folder, to_scene)
    cameras, photos = zip(*views, strict=True)
    return {
        "photos": len(scene.views),
        "size_px": textured.statistics["size_px"],
        **compared(textured, cameras, photos, picture, threads),
    }


_logger = logging.getLogger("benchmarks")

STUDY, COMMAND = "texturing", "python -m benchmarks.texturing"
PHOTOS, WIDTH, HEIGHT, SUPERSAMPLING = 24, 640, 480, 3
SIZES_PX = (512, 1024)
GREY = 140.0
PARTS = ("known", "uneven", "large", "real", "glossy")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, help="folder of the report")
    parser.add_argument(
        "--jobs", type=Path, nargs="+", default=[], help="finished jobs of real photos"
    )
    parser.add_argument(
        "--unshown", nargs="+", default=[], metavar="NAME",
        help="jobs of which the report has no picture, as where a licence forbids it",
    )  # fmt: skip
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument(
        "--only", nargs="+", choices=PARTS, default=list(PARTS), help="only these parts"
    )
    parser.add_argument("--document", action="store_true", help="measure nothing, write the page")
    options = parser.parse_args(arguments)
    out = options.out or DOCUMENTS
    out.mkdir(parents=True, exist_ok=True)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    parts = {
        "known": _known,
        "uneven": _uneven,
        "large": _large,
        "real": lambda threads: _real(options.jobs, out, threads, options.unshown),
        "glossy": lambda threads: _glossy(out, threads),
    }
    records = RECORDS / STUDY if options.out is None else out
    for name in () if options.document else options.only:
        code = code_of_tree()
        figures = {"lines": parts[name](options.threads)}
        write_figures(records / f"{STUDY}-{name}.json", figures, options.threads, code)
    _logger.info("%s", write_document(records, out))
    return 0


def write_document(records: Path, out: Path) -> Path:
    """Write the page of all parts that have a record; each says where it is from."""
    lines, commits = [], []
    for name in PARTS:
        path = records / f"{STUDY}-{name}.json"
        if path.is_file():
            record = read_figures(path)
            commits.append(record["code"]["commit"])
            lines += [*record["lines"], "", said_origin(f"{COMMAND} --only {name}", record), ""]
    return write_page(out / "texturing.md", "Unwrap and bake", commits, lines)


def _baked(photos: RenderedPhotos, size_px: int, threads: int) -> TexturedMesh:
    with tempfile.TemporaryDirectory() as folder:
        return texture_mesh(
            spot(), photos.scene(), photos, TextureSettings(size_px), Path(folder), Progress(),
            threads=threads,
        )  # fmt: skip


def _known(threads: int) -> list[str]:
    _logger.info("photos of the known texture")
    pattern, cameras = SolidTexture(), cameras_around(PHOTOS, WIDTH, HEIGHT)
    photos = photograph(spot(), pattern, cameras, SUPERSAMPLING)
    lines = [
        "## A known texture comes back",
        "",
        (
            f"A checker over a picture with the spectrum of photos, on spot; {PHOTOS} photos of "
            f"{WIDTH} x {HEIGHT}, {SUPERSAMPLING**2} rays a pixel, true cameras and true mesh. "
            "PSNR of the baked texels against the mean of the true texture over each texel."
        ),
        "",
        (
            "| texture | texels that photos show | that 2 photos show | of these baked "
            "| jump over chart borders : inside charts | gap at borders | stretch, mean "
            "| texels used | overlaps |"
        ),
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for size in SIZES_PX:
        _logger.info("bake at %d", size)
        textured = _baked(photos, size, threads)
        truth, known = true_albedo(textured, pattern)
        places = np.flatnonzero(known)
        count = photos_that_see(textured, cameras, places)
        error = (textured.albedo - truth).reshape(-1, 3)[places]
        assert textured.views is not None
        baked = textured.views.ravel()[places] > 0
        owner = raster_atlas(textured.corner_uvs, size, threads).face.ravel()[places]
        good = np.ones(len(textured.mesh.faces), bool)
        good[owner[count < 3]] = False
        found = seams(textured, pattern, good)
        figures = textured.statistics
        lines.append(
            f"| {size} | {psnr(error[baked]):.2f} dB | {psnr(error[count >= 2]):.2f} dB "
            f"| {100 * baked[count >= 2].mean():.2f} % "
            f"| {found.across:.2f} : {found.inside:.2f} levels | {found.gap:.2f} levels "
            f"| {figures['stretch_mean']:.3f} | {100 * figures['utilisation']:.0f} % "
            f"| {figures['texels_overlapping']} |"
        )
    return lines


def _grey(points: np.ndarray) -> np.ndarray:
    return np.full((len(points), 3), GREY)


def _uneven(threads: int) -> list[str]:
    from gaussian_wrapping_addon.core.texture import bake

    _logger.info("uneven photos")
    lines = [
        "## Brightness that differs within photos",
        "",
        (
            "Photos with dark corners and gradients of 6 to 10 % either way, of a grey spot: the "
            "step that one in a thousand pairs of texels four apart exceeds, at 512 x 512."
        ),
        "",
        "| photos | brightness evened | not evened |",
        "| --- | --- | --- |",
    ]
    cameras = cameras_around(PHOTOS, WIDTH, HEIGHT)
    solve = bake.solve_low_frequency_correction
    cases: tuple[tuple[str, Unevenness | None], ...] = (("even", None), ("uneven", uneven))
    for name, unevenness in cases:
        photos = photograph(spot(), _grey, cameras, 2, unevenness)
        steps = []
        for evened in (True, False):
            if not evened:
                bake.solve_low_frequency_correction = lambda c, v, p, g: (
                    np.ones((v.shape[1], 1, 1, 3)),
                    0.0,
                )
            try:
                steps.append(steps_between_texels(_baked(photos, 512, threads), 4))
            finally:
                bake.solve_low_frequency_correction = solve
        lines.append(f"| {name} | {steps[0]:.1f} levels | {steps[1]:.1f} levels |")
    return lines


def _large(threads: int) -> list[str]:
    _logger.info("a large mesh at 4096")
    module = "benchmarks.large_mesh"
    done = subprocess.run(
        [sys.executable, "-m", module, str(threads)], capture_output=True, text=True, check=True
    )
    figures = json.loads(done.stdout.splitlines()[-1])
    return [
        "## A large mesh",
        "",
        (
            f"{figures['faces']:,} faces, 4096 x 4096 texels, {figures['photos']} photos of "
            f"{figures['megapixels']:.1f} megapixels, a fresh process with compiled "
            "kernels. Memory is that of both processes together."
        ),
        "",
        "| time | processor time | most memory | unwrap | texels used | overlaps |",
        "| --- | --- | --- | --- | --- | --- |",
        (
            f"| {figures['wall_s']:.0f} s | {figures['cpu_s']:.0f} s "
            f"| {figures['peak_mib']:.0f} MiB "
            f"| {figures['unwrap']}, {figures['charts']} charts "
            f"| {100 * figures['utilisation']:.0f} % | {figures['overlaps']} |"
        ),
    ]


def _real(jobs: Sequence[Path], out: Path, threads: int, unshown: Sequence[str]) -> list[str]:
    lines = [
        "## Real photos, held out",
        "",
        (
            "Each mesh is textured without the photos that the training held out, and rendered "
            "from their cameras. PSNR and SSIM of the pixels that the mesh covers; fitted: with "
            "one gain a channel for each photo, as the exposure of a held-out photo is unknown; of "
            "themselves: baked from the held-out photos alone, about as much as one unlit texture "
            "can have, where there are more than a few of them. "
            "Pictures: the photo of median PSNR left, the rendering right."
        ),
        "",
        (
            "| job | photos | held out | faces | texture | PSNR | fitted | of themselves | SSIM "
            "| covered | overlaps |"
        ),
        "| --- " * 11 + "|",
    ]
    pictures = []
    for job in jobs:
        _logger.info("held-out photos of %s", job.name)
        picture = None if job.name in unshown else out / f"texturing-{job.name}.jpg"
        f = held_out_figures(job, picture, threads)
        lines.append(
            f"| {job.name} | {f['photos']} | {f['views']} | {f['faces']:,} "
            f"| {f['texture']['size_px']} | {f['psnr']:.2f} dB | {f['fitted_psnr']:.2f} dB "
            f"| {f['itself_psnr']:.2f} dB | {f['ssim']:.3f} | {100 * f['covered']:.0f} % "
            f"| {f['texture']['texels_overlapping']} |"
        )
        if picture is not None:
            pictures += ["", f"![{job.name}]({picture.name})"]
    return lines + pictures if jobs else [*lines[:2], "No job was named with `--jobs`."]


def _glossy(out: Path, threads: int) -> list[str]:
    lines = [
        "## Glossy things, test views",
        "",
        (
            "True meshes of the zoo's glossy scenes, textured from their photos and rendered from "
            "the cameras of test views. A texture has no gloss: what is right is what most photos "
            "show. PSNR and SSIM of the pixels that the mesh covers. Pictures: the test view of "
            "median PSNR left, the rendering right."
        ),
        "",
        "| scene | photos | texture | PSNR | SSIM | covered |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    pictures = []
    for name in SCENES:
        _logger.info("test views of %s", name)
        picture = out / f"texturing-{name}.jpg"
        f = glossy_figures(name, picture, threads)
        lines.append(
            f"| {name} | {f['photos']} | {f['size_px']} | {f['psnr']:.2f} dB | {f['ssim']:.3f} "
            f"| {100 * f['covered']:.0f} % |"
        )
        pictures += ["", f"![{name}]({picture.name})"]
    return lines + pictures


if __name__ == "__main__":
    sys.exit(main())
