# SPDX-License-Identifier: GPL-3.0-or-later
"""Helper process of :mod:`.pose_solver`: feature extraction, matching, mapping, triangulation.

Reads ``task.json``, ``images/`` and ``masks/`` of its folder, writes ``model/`` (COLMAP binary),
and ``turntable.json`` and ``turning/`` where it solves.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ...errors import DatasetError
from ...files import read_json, write_json
from ...processes.helper_process import emit
from ..photos.photo_file import write_mask
from ..pycolmap_import import import_pycolmap
from .standing_still import TURNING_FOLDER, TURNTABLE_NAME, are_turning
from .turntable_features import (
    are_usable,
    drop_still_features,
    matches_inside,
    most_inliers,
    turning_masks,
    turntable_groups,
)

DEFAULT_FOCAL_FACTORS = (1.2, 0.85, 1.7, 2.5)
"""Focal lengths over the long side to try if EXIF gives none, the most common first."""
_MIN_REGISTERED_SHARE = 0.8
"""Share of registered photos at which no other focal length is tried."""
_LENIENT_REGISTERED_SHARE = 0.5
"""Share of registered photos below which thresholds for the first pair and poses are relaxed."""
_MAX_FEATURES = 8192
_MAX_FEATURES_POSED = 4096
_MATCHING_BLOCKS = 3
_MATCHING_BLOCK_PAIRS = 1500
"""Every block rebuilds the search index of each of its photos: few, large blocks are faster."""

_EXTRACT_END, _MATCH_END = 0.5, 0.85


def main(folder: Path) -> None:
    """Run the task of ``folder``."""
    pycolmap = import_pycolmap()

    pycolmap.logging.minloglevel = 1
    task = read_json(folder / "task.json")
    pycolmap.set_random_seed(task["seed"])
    if task["mode"] == "solve":
        _solve(folder, task)
    else:
        _triangulate(folder, task)


def _solve(folder: Path, task: dict[str, Any]) -> None:
    pycolmap = import_pycolmap()

    database = folder / "database.db"
    guessed: list[int] = []
    names_of_camera: dict[int, list[str]] = {}
    with pycolmap.Database.open(database) as db:
        for group in task["groups"]:
            width, height = group["width"], group["height"]
            focal_px = group["focal_px"]
            start_px = focal_px or DEFAULT_FOCAL_FACTORS[0] * max(width, height)
            camera = pycolmap.Camera(
                model="SIMPLE_RADIAL",
                width=width,
                height=height,
                params=[start_px, width / 2, height / 2, 0.0],
            )
            camera.has_prior_focal_length = focal_px is not None
            camera_id = db.write_camera(camera)
            names_of_camera[camera_id] = group["names"]
            if focal_px is None:
                guessed.append(camera_id)
    _extract(folder, database, names_of_camera, task["threads"], _MAX_FEATURES)
    _match(folder, database, task)
    _leave_out_background(folder, database, task)
    best, total = None, sum(len(names) for names in names_of_camera.values())
    factors = DEFAULT_FOCAL_FACTORS if guessed else DEFAULT_FOCAL_FACTORS[:1]
    attempts = [(factor, False) for factor in factors] + [(factors[0], True)]
    for factor, lenient in attempts:
        if best is not None and best.num_reg_images() >= total * (
            _LENIENT_REGISTERED_SHARE if lenient else _MIN_REGISTERED_SHARE
        ):
            break
        with pycolmap.Database.open(database) as db:
            for camera_id in guessed:
                camera = db.read_camera(camera_id)
                start_px = factor * max(camera.width, camera.height)
                camera.params = [start_px, camera.width / 2, camera.height / 2, 0.0]
                db.update_camera(camera)
        found = _map(folder, database, task, total, lenient=lenient)
        if found is not None and (best is None or found.num_reg_images() > best.num_reg_images()):
            best = found
    if best is None:
        raise DatasetError(
            f"No two of the {total} photos could be placed relative to each other.",
            "Take more photos with more overlap, from a textured object that does not move.",
        )
    _write(folder, best)


def _extract(
    folder: Path,
    database: Path,
    names_of_camera: dict[int, list[str]],
    threads: int,
    max_features: int,
) -> None:
    pycolmap = import_pycolmap()

    options = pycolmap.FeatureExtractionOptions()
    options.num_threads = threads
    options.use_gpu = False
    options.sift.max_num_features = max_features
    reader = pycolmap.ImageReaderOptions()
    if any((folder / "masks").iterdir()):
        reader.mask_path = folder / "masks"
    total = sum(len(names) for names in names_of_camera.values())
    done = 0
    for camera_id, names in names_of_camera.items():
        reader.existing_camera_id = camera_id
        # Import in order first: extraction would number the photos as its threads finish.
        pycolmap.import_images(
            database,
            folder / "images",
            camera_mode=pycolmap.CameraMode.SINGLE,
            image_names=names,
            options=reader,
        )
        for begin in range(0, len(names), 2 * threads):
            block = names[begin : begin + 2 * threads]
            emit(
                fraction=_EXTRACT_END * done / total,
                message=f"searching features, photo {done + 1} of {total}",
            )
            pycolmap.extract_features(
                database,
                folder / "images",
                image_names=block,
                camera_mode=pycolmap.CameraMode.SINGLE,
                reader_options=reader,
                extraction_options=options,
                device=pycolmap.Device.cpu,
            )
            done += len(block)


def _match(
    folder: Path, database: Path, task: dict[str, Any], *, is_turntable: bool = False
) -> None:
    pycolmap = import_pycolmap()

    matching = pycolmap.FeatureMatchingOptions()
    matching.use_gpu = False
    matching.num_threads = task["threads"]
    verification = _verification_options(task, is_turntable=is_turntable)
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = folder / "pairs.txt"
    pairs = task["pairs"]
    step = max(1, min(-(-len(pairs) // _MATCHING_BLOCKS), _MATCHING_BLOCK_PAIRS))
    for begin in range(0, len(pairs), step):
        begun = _MATCH_END if is_turntable else _EXTRACT_END
        emit(
            fraction=begun + (_MATCH_END - begun) * begin / len(pairs),
            message=f"matching photos, pair {begin + 1} of {len(pairs)}",
        )
        block = pairs[begin : begin + step]
        pairing.match_list_path.write_text("".join(f"{a} {b}\n" for a, b in block))
        pycolmap.match_image_pairs(
            database,
            matching_options=matching,
            pairing_options=pairing,
            verification_options=verification,
            device=pycolmap.Device.cpu,
        )


def _leave_out_background(folder: Path, database: Path, task: dict[str, Any]) -> None:
    """Find photos of a turntable, and match them again without what stands still.

    Writes how many there are, and masks of what turns into ``turning/`` where they can be made.
    """
    groups = turntable_groups(database, task)
    names = [name for group in groups for name in group]
    # Between two places the background moves as one body, too.
    place = {name: number for number, group in enumerate(groups) for name in group}
    pairs = [(a, b) for a, b in task["pairs"] if a in place and place[a] == place.get(b)]
    if groups:
        emit(fraction=_MATCH_END, message="separating what turns from what stands still")
        _verify_again(database, task, is_turntable=True)
        turn = are_turning(most_inliers(database, names, pairs))
        if task["turntable"] == "auto" and not turn:
            _verify_again(database, task, is_turntable=False)
            groups, names = [], []
    found: dict[str, Any] = {"photos": len(names), "is_masked": False}
    if groups:

        def step(share: float) -> None:
            emit(fraction=_MATCH_END, message=f"masking what stands still, {100 * share:.0f} %")

        masks = turning_masks(folder / "images", groups, step, threads=task["threads"])
        if are_usable(masks, matches_inside(database, masks, pairs)):
            found["is_masked"] = True
            drop_still_features(database, masks)
            _match(folder, database, task, is_turntable=True)
            (folder / TURNING_FOLDER).mkdir()
            for name, mask in masks.items():
                write_mask(folder / TURNING_FOLDER / f"{name}.png", mask)
    write_json(folder / TURNTABLE_NAME, found)


def _verify_again(database: Path, task: dict[str, Any], *, is_turntable: bool) -> None:
    pycolmap = import_pycolmap()

    with pycolmap.Database.open(database) as db:
        db.clear_two_view_geometries()
    verifier = pycolmap.GeometricVerifierOptions()
    verifier.num_threads = task["threads"]
    pycolmap.geometric_verification(
        database,
        verifier_options=verifier,
        two_view_geometry_options=_verification_options(task, is_turntable=is_turntable),
    )


def _verification_options(task: dict[str, Any], *, is_turntable: bool) -> Any:
    options = import_pycolmap().TwoViewGeometryOptions()
    options.ransac.random_seed = task["seed"]
    options.filter_stationary_matches = is_turntable
    return options


def _mapping_options(seed: int) -> Any:
    pycolmap = import_pycolmap()

    options = pycolmap.IncrementalPipelineOptions()
    for part in (options, options.mapper, options.triangulation):
        part.random_seed = seed
    # One thread: the order of sums in bundle adjustment, and so the result, stays the same.
    options.num_threads = 1
    options.mapper.num_threads = 1
    return options


def _map(folder: Path, database: Path, task: dict[str, Any], total: int, *, lenient: bool) -> Any:
    """Return the largest reconstruction, or ``None``."""
    pycolmap = import_pycolmap()

    options = _mapping_options(task["seed"])
    options.min_model_size = 3
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
            fraction=_MATCH_END + (1.0 - _MATCH_END) * share,
            message=f"placing photo {min(registered, total)} of {total}",
        )

    output = folder / "models"
    output.mkdir(exist_ok=True)
    emit(fraction=_MATCH_END, message="choosing the first two photos")
    found = pycolmap.incremental_mapping(
        database, folder / "images", output, options, next_image_callback=next_photo
    )
    # Of equally large models, take the first, independent of the dictionary's order.
    ordered = [found[key] for key in sorted(found)]
    return max(ordered, key=lambda model: model.num_reg_images(), default=None)


def _triangulate(folder: Path, task: dict[str, Any]) -> None:
    pycolmap = import_pycolmap()

    database = folder / "database.db"
    photos_of_lens: dict[tuple[float, ...], list[str]] = {}
    for photo in task["photos"]:
        lens = (photo["width"], photo["height"], *photo["params"])
        photos_of_lens.setdefault(lens, []).append(photo["name"])
    names_of_camera: dict[int, list[str]] = {}
    with pycolmap.Database.open(database) as db:
        for (width, height, *params), names in photos_of_lens.items():
            camera = pycolmap.Camera(
                model="PINHOLE", width=int(width), height=int(height), params=params
            )
            camera.has_prior_focal_length = True
            names_of_camera[db.write_camera(camera)] = names
    _extract(folder, database, names_of_camera, task["threads"], _MAX_FEATURES_POSED)
    _match(folder, database, task)
    pose_of_name = {p["name"]: np.array(p["cam_from_world"]) for p in task["photos"]}
    posed = pycolmap.Reconstruction()
    with pycolmap.Database.open(database) as db:
        for camera in db.read_all_cameras():
            posed.add_camera_with_trivial_rig(camera)
        for stored in db.read_all_images():
            image = pycolmap.Image(
                name=stored.name, camera_id=stored.camera_id, image_id=stored.image_id
            )
            pose = pycolmap.Rigid3d(pose_of_name[stored.name])
            posed.add_image_with_trivial_frame(image, pose)
    emit(fraction=_MATCH_END, message="triangulating points")
    options = _mapping_options(task["seed"])
    # Keep the poses of the input: bundle adjustment may move points only.
    solved = pycolmap.triangulate_points(
        posed, database, folder / "images", folder, clear_points=True, options=options
    )
    solved.extract_colors_for_all_images(folder / "images")
    _write(folder, solved)


def _write(folder: Path, model: Any) -> None:
    output = folder / "model"
    output.mkdir()
    model.write_binary(output)
    emit(fraction=1.0, message="cameras are solved")
