# SPDX-License-Identifier: GPL-3.0-or-later
"""Place the photos of a solver's database: one after the other, or all at once.

Runs in the helper process of :mod:`.pose_solver`.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...processes.helper_process import emit
from ..matching.feature_steps import MATCH_END
from ..pycolmap_import import import_pycolmap

MIN_MODEL = 3
"""Photos of the smallest part that is kept."""
MIN_COMMON = 3
"""Photos that two parts must have in common to be joined: a similarity needs three."""
MAX_JOIN_SHARE = 0.02
"""Largest error of common centres after joining, as a share of their spread."""


def mapping_options(seed: int) -> Any:
    """Return options of the incremental mapper that give the same result for the same seed."""
    pycolmap = import_pycolmap()

    options = pycolmap.IncrementalPipelineOptions()
    for part in (options, options.mapper, options.triangulation):
        part.random_seed = seed
    # One thread: the order of sums in bundle adjustment, and so the result, stays the same.
    options.num_threads = 1
    options.mapper.num_threads = 1
    return options


def place_one_by_one(
    database: Path,
    folder: Path,
    seed: int,
    total: int,
    *,
    lenient: bool = False,
    known_lens: bool = False,
) -> list[Any]:
    """Return the reconstructions of the incremental mapper, the largest first.

    Parameters
    ----------
    folder : Path
        With ``images/``; ``models/`` is used for temporary files.
    lenient : bool
        Accept fewer matches, and a first pair with less parallax.
    known_lens : bool
        Neither the lenses nor the places of cameras in their rig are adjusted.
    """
    pycolmap = import_pycolmap()

    options = mapping_options(seed)
    options.min_model_size = MIN_MODEL
    if known_lens:
        options.ba_refine_focal_length = False
        options.ba_refine_extra_params = False
        options.ba_refine_sensor_from_rig = False
    if lenient:
        options.mapper.init_min_num_inliers = 40
        options.mapper.init_min_tri_angle = 5.0
        options.mapper.abs_pose_min_num_inliers = 15
    registered = 2

    def next_photo() -> None:
        nonlocal registered
        registered += 1
        share = min(registered / total, 1.0)
        emit(
            fraction=MATCH_END + (1.0 - MATCH_END) * share,
            message=f"placing photo {min(registered, total)} of {total}",
        )

    emit(fraction=MATCH_END, message="choosing the first two photos")
    found = pycolmap.incremental_mapping(
        database, folder / "images", _empty(folder), options, next_image_callback=next_photo
    )
    return _largest_first(found)


def place_at_once(database: Path, folder: Path, seed: int, total: int) -> list[Any]:
    """Return the reconstructions of the global mapper, the largest first."""
    pycolmap = import_pycolmap()

    options = pycolmap.GlobalPipelineOptions()
    options.num_threads = 1  # repeatable, as above
    options.random_seed = seed
    options.min_model_size = MIN_MODEL
    options.mapper.num_threads = 1
    options.mapper.random_seed = seed
    options.mapper.rotation_averaging.random_seed = seed
    options.mapper.global_positioning.random_seed = seed
    options.mapper.retriangulation.random_seed = seed
    for part in (options.mapper.global_positioning, options.mapper.bundle_adjustment.ceres):
        part.use_gpu = False
    emit(fraction=MATCH_END, message=f"placing {total} photos at once")
    found = pycolmap.global_mapping(database, folder / "images", _empty(folder), options)
    return _largest_first(found)


def _empty(folder: Path) -> Path:
    output = folder / "models"
    shutil.rmtree(output, ignore_errors=True)
    output.mkdir()
    return output


def _largest_first(found: dict[int, Any]) -> list[Any]:
    # Of equally large models the first, whatever the dictionary's order.
    ordered = [found[key] for key in sorted(found)]
    return sorted(ordered, key=lambda model: -model.num_reg_images())


def joined(database: Path, folder: Path, seed: int, models: Sequence[Any]) -> tuple[Any, int]:
    """Join parts to the largest that have three photos or more in common with it.

    Returns
    -------
    model : Reconstruction
        The first of ``models`` where nothing could be joined.
    count : int
        Photos that the others added.
    """
    pycolmap = import_pycolmap()

    first = models[0]
    added: dict[int, np.ndarray] = {}
    poses = _poses(first)
    for other in models[1:]:
        theirs = _poses(other)
        common = sorted(set(poses) & set(theirs))
        moved = _moved_onto(theirs, poses, common)
        if moved is None:
            continue
        new = {number: pose for number, pose in moved.items() if number not in poses}
        added |= new
        poses |= new
    if not added:
        return first, 0
    emit(fraction=MATCH_END, message=f"joining parts, {len(added)} photos more")
    posed = pycolmap.Reconstruction()
    with pycolmap.Database.open(database) as db:
        for camera in db.read_all_cameras():
            lens = first.camera(camera.camera_id) if first.exists_camera(camera.camera_id) else None
            posed.add_camera_with_trivial_rig(camera if lens is None else lens)
        for stored in db.read_all_images():
            if stored.image_id in poses:
                image = pycolmap.Image(
                    name=stored.name, camera_id=stored.camera_id, image_id=stored.image_id
                )
                posed.add_image_with_trivial_frame(image, pycolmap.Rigid3d(poses[stored.image_id]))
    target = folder / "joined"
    target.mkdir(exist_ok=True)
    model = pycolmap.triangulate_points(
        posed, database, folder / "images", target, clear_points=True,
        options=mapping_options(seed),
    )  # fmt: skip
    adjustment = pycolmap.BundleAdjustmentOptions()
    adjustment.ceres.solver_options.num_threads = 1
    pycolmap.bundle_adjustment(model, adjustment)
    return model, len(added)


def _poses(model: Any) -> dict[int, np.ndarray]:
    """Return (3, 4) cam_from_world of the placed photos by their number."""
    return {
        number: np.asarray(model.image(number).cam_from_world().matrix())
        for number in sorted(model.reg_image_ids())
    }


def _moved_onto(
    theirs: dict[int, np.ndarray], ours: dict[int, np.ndarray], common: Sequence[int]
) -> dict[int, np.ndarray] | None:
    """Return their poses in our frame, None where the common photos do not tell it."""
    if len(common) < MIN_COMMON:
        return None
    # R_ours = R_theirs Q^T: the mean of the rotations, by singular values.
    turn = sum(ours[k][:, :3].T @ theirs[k][:, :3] for k in common)
    u, _, vt = np.linalg.svd(turn)
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    source = np.array([_center(theirs[k]) for k in common]) @ rotation.T
    target = np.array([_center(ours[k]) for k in common])
    a, b = source - source.mean(0), target - target.mean(0)
    scale = float((a * b).sum() / max((a * a).sum(), 1e-300))
    spread = float(np.sqrt((b**2).sum(1).mean()))
    error = float(np.sqrt(((scale * a - b) ** 2).sum(1).mean()))
    if scale <= 0.0 or error > MAX_JOIN_SHARE * spread:
        return None
    shift = target.mean(0) - scale * source.mean(0)
    moved = {}
    for number, pose in theirs.items():
        turned = pose[:, :3] @ rotation.T
        center = scale * rotation @ _center(pose) + shift
        moved[number] = np.concatenate([turned, -(turned @ center)[:, None]], 1)
    return moved


def _center(pose: np.ndarray) -> np.ndarray:
    return -pose[:, :3].T @ pose[:, 3]
