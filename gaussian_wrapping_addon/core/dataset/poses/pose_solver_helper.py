# SPDX-License-Identifier: GPL-3.0-or-later
"""Helper process of :mod:`.pose_solver`: feature extraction, matching, mapping, triangulation.

Reads ``task.json``, ``images/`` and ``masks/`` of its folder, writes ``model/`` (COLMAP binary),
and ``turntable.json``, ``turning/`` and ``solution.json`` where it solves.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ...errors import DatasetError
from ...files import read_json, write_json
from ...processes.helper_process import emit
from ..matching.feature_steps import MATCH_END, extract, match, match_chosen, verify_again
from ..matching.match_pairs import EXHAUSTIVE_LIMIT
from ..photos.photo_file import write_mask
from ..pycolmap_import import import_pycolmap
from .mapping import joined, mapping_options, place_at_once, place_one_by_one
from .mending import mended
from .solution_check import check_solution
from .solution_findings import SOLUTION_NAME
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
_MAX_FEATURES_MANY = 2048
"""Of a photo of a set whose pairs are chosen: matching time grows with its square."""
_MAX_FEATURES_POSED = 4096
_MAX_FEATURES_PANORAMA = 2048
"""Of each of a panorama's views: there are 14, and each is matched with many."""


def main(folder: Path) -> None:
    """Run the task of ``folder``."""
    pycolmap = import_pycolmap()

    pycolmap.logging.minloglevel = 1
    task = read_json(folder / "task.json")
    pycolmap.set_random_seed(task["seed"])
    if task["mode"] == "solve":
        _solve(folder, task)
    elif task["mode"] == "panoramas":
        _solve_panoramas(folder, task)
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
    total = sum(len(names) for names in names_of_camera.values())
    is_small = total <= EXHAUSTIVE_LIMIT
    features = _MAX_FEATURES if is_small else _MAX_FEATURES_MANY
    extract(folder, database, names_of_camera, task["threads"], features)
    names = sorted(name for group in names_of_camera.values() for name in group)
    match_chosen(folder, database, task, names)
    _leave_out_background(folder, database, task)

    accounts: list[dict[str, Any]] = []

    def solve(database: Path) -> Any:
        model, account = _place(folder, database, task, total, guessed)
        accounts.append(account)
        return model

    best = solve(database)
    if best is None:
        raise DatasetError(
            f"No two of the {total} photos could be placed relative to each other.",
            "Take more photos with more overlap, from a textured object that does not move.",
        )
    verdict = check_solution(database, best)
    is_mended = False
    if verdict.is_doubtful:
        best, verdict, is_mended = mended(database, folder, solve, best, verdict)
    said = accounts[-1 if is_mended else 0]
    if said["joined"] or said["mapper"] == "global":  # the incremental mapper has done so
        best.extract_colors_for_all_images(folder / "images")
        best.update_point_3d_errors()
    placed = [best.image(number).name for number in sorted(best.reg_image_ids())]
    said |= verdict.to_json(placed)
    said |= {"is_doubtful": verdict.is_doubtful, "is_mended": is_mended}
    said["pairs_matched"] = len(task["pairs"])
    write_json(folder / SOLUTION_NAME, said)
    _write(folder, best)


def _solve_panoramas(folder: Path, task: dict[str, Any]) -> None:
    """Solve views of panoramas as a rig whose directions and lens are known and stay."""
    pycolmap = import_pycolmap()

    database = folder / "database.db"
    side, focal_px = task["side"], task["focal_px"]
    rotations = [np.array(rows) for rows in task["cam_from_panorama"]]
    names_of_camera: dict[int, list[str]] = {}
    rig = []
    with pycolmap.Database.open(database) as db:
        for view, rotation in enumerate(rotations):
            camera = pycolmap.Camera(
                model="PINHOLE",
                width=side,
                height=side,
                params=[focal_px, focal_px, side / 2, side / 2],
            )
            camera.has_prior_focal_length = True
            names = [f"{view:02d}/{number:06d}.jpg" for number in range(task["panoramas"])]
            names_of_camera[db.write_camera(camera)] = names
            sensor = pycolmap.RigConfigCamera(ref_sensor=view == 0, image_prefix=f"{view:02d}/")
            if view:
                turned = rotation @ rotations[0].T
                sensor.cam_from_rig = pycolmap.Rigid3d(np.c_[turned, np.zeros(3)])
            rig.append(sensor)
    extract(folder, database, names_of_camera, task["threads"], _MAX_FEATURES_PANORAMA)
    with pycolmap.Database.open(database) as db:
        pycolmap.apply_rig_config([pycolmap.RigConfig(cameras=rig)], db)
    match(folder, database, task)
    total = task["panoramas"] * len(rotations)
    found = place_one_by_one(database, folder, task["seed"], total, known_lens=True)
    if not found:
        raise DatasetError(
            f"No two of the {task['panoramas']} panoramas could be placed relative to each other.",
            "Take more panoramas, a few steps apart.",
        )
    _write(folder, found[0])


def _place(
    folder: Path, database: Path, task: dict[str, Any], total: int, guessed: list[int]
) -> tuple[Any, dict[str, Any]]:
    """Return the best reconstruction or None, and how it was found.

    Many photos are placed all at once first, which takes a fraction of the time.
    """
    if total > EXHAUSTIVE_LIMIT:
        models = place_at_once(database, folder, task["seed"], total)
        model, said = _best_of(folder, database, task, models, "global")
        enough = model is not None and model.num_reg_images() >= _MIN_REGISTERED_SHARE * total
        if enough and not check_solution(database, model).is_doubtful:
            return model, said
        one_by_one, other = _place_one_by_one(folder, database, task, total, guessed)
        if model is None or (
            one_by_one is not None
            and check_solution(database, one_by_one).agreeing
            > check_solution(database, model).agreeing
        ):
            return one_by_one, other
        return model, said
    return _place_one_by_one(folder, database, task, total, guessed)


def _place_one_by_one(
    folder: Path, database: Path, task: dict[str, Any], total: int, guessed: list[int]
) -> tuple[Any, dict[str, Any]]:
    """Try focal lengths, where EXIF gives none, until most photos can be placed."""
    pycolmap = import_pycolmap()

    best: list[Any] = []
    factors = DEFAULT_FOCAL_FACTORS if guessed else DEFAULT_FOCAL_FACTORS[:1]
    attempts = [(factor, False) for factor in factors] + [(factors[0], True)]
    for factor, lenient in attempts:
        if best and best[0].num_reg_images() >= total * (
            _LENIENT_REGISTERED_SHARE if lenient else _MIN_REGISTERED_SHARE
        ):
            break
        with pycolmap.Database.open(database) as db:
            for camera_id in guessed:
                camera = db.read_camera(camera_id)
                start_px = factor * max(camera.width, camera.height)
                camera.params = [start_px, camera.width / 2, camera.height / 2, 0.0]
                db.update_camera(camera)
        found = place_one_by_one(database, folder, task["seed"], total, lenient=lenient)
        if found and (not best or found[0].num_reg_images() > best[0].num_reg_images()):
            best = found
    return _best_of(folder, database, task, best, "incremental")


def _best_of(
    folder: Path, database: Path, task: dict[str, Any], models: list[Any], mapper: str
) -> tuple[Any, dict[str, Any]]:
    """Join parts, and name the photos of those that stay apart."""
    said: dict[str, Any] = {"mapper": mapper, "joined": 0, "apart": []}
    if not models:
        return None, said
    model, said["joined"] = joined(database, folder, task["seed"], models)
    placed = set(model.reg_image_ids())
    for other in models[1:]:
        apart = [other.image(k).name for k in sorted(set(other.reg_image_ids()) - placed)]
        placed.update(other.reg_image_ids())
        said["apart"] += [apart] if apart else []
    return model, said


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
        emit(fraction=MATCH_END, message="separating what turns from what stands still")
        verify_again(database, task, is_turntable=True)
        turn = are_turning(most_inliers(database, names, pairs))
        if task["turntable"] == "auto" and not turn:
            verify_again(database, task, is_turntable=False)
            groups, names = [], []
    found: dict[str, Any] = {"photos": len(names), "is_masked": False}
    if groups:

        def step(share: float) -> None:
            emit(fraction=MATCH_END, message=f"masking what stands still, {100 * share:.0f} %")

        masks = turning_masks(folder / "images", groups, step, threads=task["threads"])
        if are_usable(masks, matches_inside(database, masks, pairs)):
            found["is_masked"] = True
            drop_still_features(database, masks)
            match(folder, database, task, begin=MATCH_END, is_turntable=True)
            (folder / TURNING_FOLDER).mkdir()
            for name, mask in masks.items():
                write_mask(folder / TURNING_FOLDER / f"{name}.png", mask)
    write_json(folder / TURNTABLE_NAME, found)


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
    extract(folder, database, names_of_camera, task["threads"], _MAX_FEATURES_POSED)
    match(folder, database, task)
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
    emit(fraction=MATCH_END, message="triangulating points")
    options = mapping_options(task["seed"])
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
