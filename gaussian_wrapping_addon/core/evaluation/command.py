# SPDX-License-Identifier: GPL-3.0-or-later
"""Evaluate one mesh against one ground truth: the command ``evaluate``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import DatasetError, ParseError, UsageError
from ..files import read_json
from ..loading.source_kind import read_poses, source_kind
from ..progress import Progress
from ..scene.camera import Camera, Similarity
from .alignment import IcpResult, icp, pose_errors
from .dtu import align_to_scan, is_dtu_folder, read_dtu, score_dtu
from .dtu_chamfer import DENSITY_MM, MAX_DISTANCE_MM, PATCH_MM
from .layouts import SAMPLES as TANKS_SAMPLES
from .layouts import (
    align_to_log,
    is_cloud,
    is_tanks_folder,
    read_cloud,
    read_mesh,
    read_tanks,
    score_tanks,
)
from .surface_scores import (
    MIN_THIN_SHARE,
    PROTOCOLS,
    TRUTH_FILE,
    SurfaceSamples,
    Truth,
    read_truth,
    sample_uniformly,
    score_protocols,
)

LAYOUTS = ("auto", "scene", "mesh", "tanks", "dtu")
ALIGNMENTS = ("none", "cameras", "icp")
SHARES = (0.0025, 0.005, 0.01)
"""Default thresholds as shares of the truth's diagonal."""
SAMPLES = 200_000
FRAME_MISMATCH_SHARE = 0.01
"""Cameras farther than this share of their spread from the true ones are in another frame if an
alignment brings them nearer; equal to the largest of :data:`SHARES`."""
ICP_REACH = (0.05, 0.01)
"""Maximum distance of pairs in the two stages of ``--align icp``, shares of the diagonal."""

_Mesh = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class EvaluationRequest:
    """Options of an evaluation; ``None`` means the default of the layout."""

    truth: Path
    layout: str = "auto"
    scan: int | None = None
    shares: tuple[float, ...] | None = None
    distances: tuple[float, ...] | None = None
    align: str | None = None
    protocols: tuple[str, ...] | None = None
    samples: int | None = None
    seed: int = 0
    threads: int = 1

    def checked(self) -> EvaluationRequest:
        """Validate the options and return the request itself.

        Raises
        ------
        UsageError
            An option has an invalid value.
        """
        for name, value, known in (
            ("--layout", self.layout, LAYOUTS),
            ("--align", self.align, ALIGNMENTS),
        ):
            if value is not None and value not in known:
                raise UsageError(f"{name} {value} is unknown.", f"Use {', '.join(known)}.")
        if self.protocols is not None and not self.protocols:
            raise UsageError("--protocols is empty.", f"Use {', '.join(PROTOCOLS)}.")
        if unknown := [p for p in self.protocols or () if p not in PROTOCOLS]:
            raise UsageError(f"Protocol {unknown[0]!r} is unknown.", f"Use {', '.join(PROTOCOLS)}.")
        for name, values in (("--thresholds", self.shares), ("--distances", self.distances)):
            if values is not None and not (values and all(0 < v < float("inf") for v in values)):
                raise UsageError(f"{name} needs positive numbers.", "Separate them by commas.")
        if self.shares is not None and self.distances is not None:
            raise UsageError(
                "--thresholds and --distances were both given.", "Give only one of them."
            )
        if self.samples is not None and self.samples < 1:
            raise UsageError(f"--samples {self.samples} is too few.", "Give at least 1.")
        return self


def find_layout(request: EvaluationRequest) -> str:
    """Return the layout of the truth: as requested, or detected from the files.

    Raises
    ------
    DatasetError
        The path does not exist, or matches none of the layouts.
    """
    path = request.truth
    if not path.exists():
        raise DatasetError(f"{path} does not exist.", "Check the path after --truth.")
    if request.layout != "auto":
        return request.layout
    if path.is_file():
        return "mesh"
    if (path / TRUTH_FILE).is_file():
        return "scene"
    if is_tanks_folder(path):
        return "tanks"
    if is_dtu_folder(path):
        return "dtu"
    raise DatasetError(
        f"{path.name} is not a known ground truth.",
        f"Give a mesh or cloud, a folder with {TRUTH_FILE}, a scene of Tanks and Temples "
        "(NAME_trans.txt and the files beside it), or a DTU folder (Points/stl, ObsMask).",
    )


def read_cameras(path: Path) -> list[Camera]:
    """Read the cameras of an input that has them, in the frame of the file.

    Lens distortion is ignored; focal length and principal point suffice for alignment and for the
    virtual scan, which only needs visibility.

    Raises
    ------
    DatasetError, ParseError
    """
    cameras = []
    for photo in read_poses(source_kind(path)).photos:
        if photo.lens is None:
            raise DatasetError(
                f"The camera of {photo.name} has no photo size.",
                "Give cameras with photo sizes: a COLMAP project, or a transforms.json with w, h.",
            )
        (fx, fy), (cx, cy) = photo.lens.focal, photo.lens.principal_point
        size = photo.lens.width, photo.lens.height
        cameras.append(Camera(photo.name, *size, fx, fy, cx, cy, photo.cam_from_world))
    return cameras


def evaluate_mesh(
    vertices: np.ndarray, faces: np.ndarray, cameras: Sequence[Camera], request: EvaluationRequest,
    progress: Progress,
) -> dict[str, Any]:  # fmt: skip
    """Align and score a mesh of vertices (v, 3) and faces (f, 3).

    The cameras are those of the reconstruction, in the mesh's frame, or none if unknown. Returns
    plain JSON values: layout, truth, thresholds, alignment, and the scores.

    Raises
    ------
    UsageError, DatasetError, ParseError
    """
    request = request.checked()
    layout = find_layout(request)
    mesh = vertices, faces
    if layout == "tanks":
        result = _tanks(mesh, cameras, request, progress)
    elif layout == "dtu":
        result = _dtu(mesh, cameras, request, progress)
    else:
        result = _surface(mesh, cameras, request, layout, progress)
    return {"layout": layout, "seed": request.seed, **result}


def _require_cameras(cameras: Sequence[Camera]) -> None:
    if not cameras:
        raise UsageError(
            "Alignment by cameras needs the cameras of the reconstruction.",
            "Evaluate the job folder instead of its mesh, give --cameras, or place the mesh "
            "yourself and use --align none.",
        )


def _protocols(request: EvaluationRequest, cameras: Sequence[Camera]) -> tuple[str, ...]:
    """Return the requested protocols, or all that are possible."""
    if request.protocols is not None:
        return request.protocols
    return tuple(p for p in PROTOCOLS if p != "scan" or cameras)


def _surface(
    mesh: _Mesh, cameras: Sequence[Camera], request: EvaluationRequest, layout: str,
    progress: Progress,
) -> dict[str, Any]:  # fmt: skip
    progress.update(0.0, "reading the truth")
    true_cameras: list[Camera] = []
    if layout == "scene":
        truth, diagonal = read_truth(request.truth), _scene_diagonal(request.truth / "scene.json")
        true_cameras = read_cameras(request.truth)
    else:
        truth, diagonal = _mesh_truth(request)
    align = request.align or "none"
    transform = Similarity()
    alignment: dict[str, Any] = {"method": align}
    poses, pose_note = None, ""
    if align == "cameras" or (align == "icp" and cameras and true_cameras):
        if layout == "mesh":
            raise UsageError(
                "A mesh or cloud as truth has no cameras to align by.", "Use --align icp or none."
            )
        _require_cameras(cameras)
        poses = pose_errors(cameras, true_cameras)
        transform = poses.transform
    if align == "icp":
        progress.update(0.1, "aligning by nearest points")
        transform, stages = _icp(mesh, truth, transform, diagonal, request)
        alignment["stages"] = [
            {"fitness": s.fitness, "rmse": s.rmse, "iterations": s.iterations} for s in stages
        ]
    if poses is None and cameras and true_cameras:
        # Not requested: if they cannot be measured, the scores still can.
        try:
            poses = pose_errors(cameras, true_cameras)
        except DatasetError as error:
            pose_note = str(error)
    viewers = true_cameras or [camera.moved(transform) for camera in cameras]
    protocols = _protocols(request, viewers)
    shares = request.shares or (None if request.distances else SHARES)
    distances = request.distances or tuple(s * diagonal for s in shares or ())
    progress.update(0.3, "measuring distances")
    scores = score_protocols(
        transform.points(mesh[0]), mesh[1], truth, viewers, distances,
        count=request.samples or SAMPLES, seed=request.seed, threads=request.threads,
        protocols=protocols,
    )  # fmt: skip
    return {
        "diagonal": diagonal, "distances": list(distances),
        "shares_of_diagonal": None if shares is None else list(shares),
        "samples": request.samples or SAMPLES, "truth_samples": len(truth.samples),
        "alignment": {**alignment, "transform": transform.to_json()},
        "pose_errors": None if poses is None else poses.to_json(), "pose_note": pose_note,
        "scan_cameras": len(viewers) if "scan" in protocols else 0,
        "scores": {name: score.to_json() for name, score in scores.items()},
    }  # fmt: skip


def _scene_diagonal(path: Path) -> float:
    try:
        values = read_json(path, follow_links=True)
    except OSError as error:
        raise ParseError(
            path, "whole file", f"cannot be read: {error.strerror}.", "Make the scene again."
        ) from None
    diagonal = values.get("diagonal") if isinstance(values, dict) else None
    if isinstance(diagonal, bool) or not isinstance(diagonal, (int, float)) or not diagonal > 0:
        raise ParseError(path, "diagonal", "a length was expected.", "Make the scene again.")
    return float(diagonal)


def _mesh_truth(request: EvaluationRequest) -> tuple[Truth, float]:
    path = request.truth
    if not path.is_file():
        raise DatasetError(f"{path} is not a file.", "Give a mesh or a cloud, or another --layout.")
    if is_cloud(path):
        points = read_cloud(path)
        truth = Truth(SurfaceSamples(points, np.zeros_like(points)))
    else:
        mesh = read_mesh(path)
        count = request.samples or SAMPLES
        # Another seed than for the prediction: identical samples would favour identical meshes.
        truth = Truth(sample_uniformly(*mesh, count, seed=request.seed + 1), *mesh)
        points = mesh[0][np.unique(mesh[1])]
    diagonal = float(np.linalg.norm(np.ptp(points, axis=0)))
    if not diagonal > 0:
        raise ParseError(path, "vertices", "all lie in one place.", "Export the file again.")
    return truth, diagonal


def _icp(
    mesh: _Mesh, truth: Truth, start: Similarity, diagonal: float, request: EvaluationRequest
) -> tuple[Similarity, list[IcpResult]]:
    """Run two stages of ICP with scale on uniform samples, from distant pairs to near ones."""
    count = min(request.samples or SAMPLES, SAMPLES)
    points = sample_uniformly(*mesh, count, seed=request.seed).points
    stages: list[IcpResult] = []
    for reach in ICP_REACH:
        moving = points
        if truth.crop is not None:
            moving = points[truth.crop.contains(start.points(points))]
        found = icp(
            moving, truth.samples.points, start, max_distance=reach * diagonal, with_scale=True,
            threads=request.threads,
        )  # fmt: skip
        stages.append(found)
        start = found.transform
    return start, stages


def _tanks(
    mesh: _Mesh, cameras: Sequence[Camera], request: EvaluationRequest, progress: Progress
) -> dict[str, Any]:
    if request.shares is not None or len(request.distances or (0.0,)) > 1:
        raise UsageError(
            "Tanks and Temples uses a single distance.", "Give one with --distances, or none."
        )
    progress.update(0.0, "reading the truth")
    scene = read_tanks(request.truth, request.distances[0] if request.distances else None)
    align = request.align or "icp"
    start = Similarity()
    alignment: dict[str, Any] = {"method": align}
    if align == "cameras" or (align == "icp" and (cameras or request.align is None)):
        _require_cameras(cameras)
        found = align_to_log(cameras, scene, seed=request.seed)
        start = found.transform
        alignment["cameras"] = {
            "matched": len(found.inliers),
            "agreeing": int(found.inliers.sum()),
            "rmse": found.rmse,
            "transform": start.to_json(),
        }
    samples = request.samples or TANKS_SAMPLES
    protocols = _protocols(request, cameras)
    scores = score_tanks(
        mesh, cameras, scene, start,
        refine=align == "icp", protocols=protocols, samples=samples,
        seed=request.seed, threads=request.threads, progress=progress.span(0.1, 1.0),
    )  # fmt: skip
    return {
        "scene": scene.name, "distances": [scene.threshold], "voxel": scene.threshold / 2,
        "samples": samples, "truth_samples": len(scene.cloud), "alignment": alignment,
        "scan_cameras": len(cameras) if "scan" in protocols else 0, "scores": scores,
    }  # fmt: skip


def _dtu(
    mesh: _Mesh, cameras: Sequence[Camera], request: EvaluationRequest, progress: Progress
) -> dict[str, Any]:
    if request.scan is None:
        raise UsageError("A DTU folder holds many scans.", "Choose one: --scan 24.")
    if request.shares or request.distances or request.protocols or request.samples:
        raise UsageError(
            "DTU has its own protocol.", "Omit --thresholds, --distances, --protocols, --samples."
        )
    align = request.align or "cameras"
    if align == "icp":
        raise UsageError("DTU is aligned by its known cameras.", "Use --align cameras or none.")
    progress.update(0.0, "reading the truth")
    truth = read_dtu(request.truth, request.scan)
    transform = Similarity()
    alignment: dict[str, Any] = {"method": align}
    if align == "cameras":
        _require_cameras(cameras)
        found = align_to_scan(cameras, truth)
        transform = found.transform
        alignment |= {"source": truth.camera_source, **found.to_json()}
    progress.update(0.2, "measuring distances")
    score = score_dtu(*mesh, truth, transform, seed=request.seed, threads=request.threads)
    return {
        "scan": truth.scan, "density_mm": DENSITY_MM, "patch_mm": PATCH_MM,
        "max_distance_mm": MAX_DISTANCE_MM, "truth_samples": len(truth.cloud),
        "alignment": {"transform": transform.to_json(), **alignment},
        "scores": {"dtu": score.to_json()},
    }  # fmt: skip


def table(result: dict[str, Any]) -> list[str]:
    """Return the scores as lines for a terminal, with the recall of thin parts if there are any."""
    align = result["alignment"]["method"]
    lines = [f"layout {result['layout']}, alignment {align}, seed {result['seed']}"]
    if result["layout"] == "dtu":
        score = result["scores"]["dtu"]
        for name in ("accuracy", "completeness", "overall"):
            lines.append(f"{name:13s} {_figure(score[name])} mm")
        return lines
    lines.append(f"{'protocol':9s} {'distance':>10s} {'precision':>9s} {'recall':>9s} {'F1':>9s}")
    for protocol, entry in result["scores"].items():
        if result["layout"] == "tanks":
            score = entry["score"]
            rows = [(score["threshold"], score["precision"], score["recall"], score["f1"])]
        else:
            names = ("thresholds", "precision", "recall", "f1")
            rows = list(zip(*(entry[name] for name in names), strict=True))
        for distance, *figures in rows:
            texts = " ".join(f"{figure:9.4f}" for figure in figures)
            lines.append(f"{protocol:9s} {distance:10.4g} {texts}")
    if result["layout"] != "tanks":
        for protocol, entry in result["scores"].items():
            lines.append(
                f"{protocol:9s} Chamfer mean {_figure(entry['chamfer_mean'])}, "
                f"median {_figure(entry['chamfer_median'])} (in the truth's units), "
                f"normal consistency {entry['normal_consistency']:.4f}"
            )
            thin = entry["thin_count"] >= MIN_THIN_SHARE * entry["truth_count"]
            if thin and entry["thin_recall"] is not None:
                shares = " ".join(f"{share:.4f}" for share in entry["thin_recall"])
                lines.append(f"{protocol:9s} recall of thin parts {shares}")
    return lines + _pose_lines(result, align)


def _pose_lines(result: dict[str, Any], align: str) -> list[str]:
    """Return the pose errors, with a warning if the mesh may be in another frame."""
    poses = result.get("pose_errors")
    if not poses:
        note = result.get("pose_note")
        return [f"poses     not compared: {note}"] if note else []
    given, aligned = poses["given_share_median"], poses["center_share_median"]
    lines = [
        (
            f"poses     centres {100 * aligned:.3g} % of the spread, "
            f"rotations {poses['rotation_degrees_median']:.3g} degrees (medians of "
            f"{poses['cameras']}, after their own best alignment)"
        )
    ]
    if align == "none" and given > max(FRAME_MISMATCH_SHARE, 2.0 * aligned):
        lines.append(
            f"poses     the cameras are in another frame (scale "
            f"{poses['transform']['scale']:.4g}, shift {given * poses['spread']:.4g} in the "
            "truth's units): try --align cameras"
        )
    return lines


def _figure(value: float | None) -> str:
    return "infinite" if value is None else f"{value:.4g}"
