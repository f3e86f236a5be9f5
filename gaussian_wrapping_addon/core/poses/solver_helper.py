# SPDX-License-Identifier: GPL-3.0-or-later
"""The helper that solves camera poses with pycolmap."""

from __future__ import annotations

import contextlib
import shutil
import sqlite3
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import DatasetError
from ..files import read_json, write_json
from ..photos.photo_file import write_mask
from ..readers.lenses import import_pycolmap
from ..scene.camera import pose_at
from ..worker.helper_process import emit
from .checks import (
    SOLUTION_NAME,
    TURNING_FOLDER,
    TURNTABLE_NAME,
    Verdict,
    are_turning,
    check_solution,
)
from .matching import EXHAUSTIVE_LIMIT, MATCH_END, extract, match, match_chosen, verify_again
from .turntable import (
    are_usable,
    drop_still_features,
    matches_inside,
    most_inliers,
    turning_masks,
    turntable_groups,
)

# -- Place the photos of a solver's database: one after the other, or all at once -----------------

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
    options.num_threads = options.mapper.num_threads = 1
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
        options.ba_refine_focal_length = options.ba_refine_extra_params = False
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
    options.min_model_size = MIN_MODEL
    mapper = options.mapper
    options.num_threads = mapper.num_threads = 1  # repeatable, as above
    steps = mapper.rotation_averaging, mapper.global_positioning, mapper.retriangulation
    for part in (options, mapper, *steps):
        part.random_seed = seed
    mapper.global_positioning.use_gpu = mapper.bundle_adjustment.ceres.use_gpu = False
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

    Returns the model, the first of ``models`` where nothing could be joined, and how many photos
    the others added.
    """
    pycolmap = import_pycolmap()
    first = models[0]
    added: dict[int, np.ndarray] = {}
    poses = _poses(first)
    for other in models[1:]:
        moved = _moved_onto(_poses(other), poses)
        new = {number: pose for number, pose in moved.items() if number not in poses}
        added |= new
        poses |= new
    if not added:
        return first, 0
    emit(fraction=MATCH_END, message=f"joining parts, {len(added)} photos more")
    target = folder / "joined"
    target.mkdir(exist_ok=True)

    def lens(stored: Any) -> Any:
        number = stored.camera_id
        return first.camera(number) if first.exists_camera(number) else stored

    model = _triangulated(database, folder, target, seed, poses, lens)
    adjustment = pycolmap.BundleAdjustmentOptions()
    adjustment.ceres.solver_options.num_threads = 1
    pycolmap.bundle_adjustment(model, adjustment)
    return model, len(added)


def _triangulated(
    database: Path,
    folder: Path,
    target: Path,
    seed: int,
    poses: Mapping[int, np.ndarray],
    lens: Callable[[Any], Any],
) -> Any:
    """Return the reconstruction of the photos that have (3, 4) poses, by number, which stay.

    ``lens`` returns the camera to use for one of the database.
    """
    pycolmap = import_pycolmap()
    posed = pycolmap.Reconstruction()
    with pycolmap.Database.open(database) as db:
        for camera in db.read_all_cameras():
            posed.add_camera_with_trivial_rig(lens(camera))
        for stored in db.read_all_images():
            if stored.image_id in poses:
                image = pycolmap.Image(
                    name=stored.name, camera_id=stored.camera_id, image_id=stored.image_id
                )
                posed.add_image_with_trivial_frame(image, pycolmap.Rigid3d(poses[stored.image_id]))
    # Bundle adjustment may move points only.
    return pycolmap.triangulate_points(
        posed, database, folder / "images", target, clear_points=True,
        options=mapping_options(seed),
    )  # fmt: skip


def _poses(model: Any) -> dict[int, np.ndarray]:
    """Return (3, 4) cam_from_world of the placed photos by their number."""
    return {
        number: np.asarray(model.image(number).cam_from_world().matrix())
        for number in sorted(model.reg_image_ids())
    }


def _moved_onto(
    theirs: dict[int, np.ndarray], ours: dict[int, np.ndarray]
) -> dict[int, np.ndarray]:
    """Return their poses in our frame; none where the common photos do not tell it."""
    common = sorted(set(ours) & set(theirs))
    if len(common) < MIN_COMMON:
        return {}
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
        return {}
    shift = target.mean(0) - scale * source.mean(0)
    moved = {}
    for number, pose in theirs.items():
        moved[number] = pose_at(pose[:, :3] @ rotation.T, scale * rotation @ _center(pose) + shift)
    return moved


def _center(pose: np.ndarray) -> np.ndarray:
    return -pose[:, :3].T @ pose[:, 3]


# -- Solve doubtful cameras again from the most alike pairs (docs/method.md, section 15.3) --------
#
# Where things repeat, photos match that show different things. They have less in common than true
# neighbours: beside what repeats, each shows things that the other does not.

MOST_ALIKE = 3
"""Pairs of each photo by which two solutions are compared."""
TREE_STEPS = 3
"""Pairs are kept whose photos are at most so many steps apart along the tree of the most alike."""
MAX_LEFT = 0.5
"""Most alike pairs that may contradict a better solution, over those that contradict the first."""
MIN_PLACED = 0.9
"""Photos that a mended solution places, over those of the one that it replaces."""

Alike = Mapping[tuple[int, int], float]
"""Of pairs of photos' numbers: features that match over all features of both that match any."""


def mended(
    database: Path, folder: Path, solve: Callable[[Path], Any], model: Any, verdict: Verdict
) -> tuple[Any, Verdict, bool]:
    """Solve again from the most alike pairs; keep the result if these contradict it far less.

    Parameters
    ----------
    database : Path
        With the verified pairs, all of which judge every solution.
    folder : Path
        For temporary files.
    solve : callable
        Returns the reconstruction of a database, or None.
    model, verdict
        The doubtful solution.

    Returns
    -------
    model, verdict
        Those given where the other is not better.
    is_mended : bool
        They are the other.
    """
    emit(
        fraction=MATCH_END,
        message=f"{len(verdict.contradicting)} pairs of photos contradict the cameras: solving "
        "again from the most alike",
    )
    trial = folder / "alike.db"
    with (
        contextlib.closing(sqlite3.connect(database)) as one,
        contextlib.closing(sqlite3.connect(trial)) as other,
    ):
        one.backup(other)
    alike = pair_likeness(database)
    kept = near_in_tree(alike)
    pycolmap = import_pycolmap()
    with pycolmap.Database.open(trial) as db:
        names = {image.image_id: image.name for image in db.read_all_images()}
        for pair in alike:
            if pair not in kept:
                db.delete_two_view_geometry(*pair)
    found = solve(trial)
    if found is None or found.num_reg_images() < MIN_PLACED * model.num_reg_images():
        return model, verdict, False
    judged = check_solution(database, found)
    closest = {frozenset((names[a], names[b])) for a, b in most_alike(alike)}
    left, before = (
        sum(p.contradicts and frozenset((p.first, p.second)) in closest for p in one.pairs)
        for one in (judged, verdict)
    )
    return (found, judged, True) if left <= MAX_LEFT * before else (model, verdict, False)


def pair_likeness(database: Path) -> dict[tuple[int, int], float]:
    """Return how alike the photos of verified pairs are, in (0, 1]."""
    pycolmap = import_pycolmap()
    with pycolmap.Database.open(database) as db:
        matches = {
            pycolmap.pair_id_to_image_pair(pair_id): geometry.inlier_matches
            for pair_id, geometry in zip(*db.read_two_view_geometries(), strict=True)
            if len(geometry.inlier_matches)
        }
    features: dict[int, list[np.ndarray]] = defaultdict(list)
    for pair, found in matches.items():
        for side, number in enumerate(pair):
            features[number].append(found[:, side])
    useful = {number: len(np.unique(np.concatenate(all_))) for number, all_ in features.items()}
    return {
        (a, b): len(found) / (useful[a] + useful[b] - len(found))
        for (a, b), found in matches.items()
    }


def most_alike(alike: Alike) -> set[tuple[int, int]]:
    """Return the ``MOST_ALIKE`` pairs of each photo."""
    of_photo: dict[int, list[tuple[float, tuple[int, int]]]] = defaultdict(list)
    for pair, value in alike.items():
        for number in pair:
            of_photo[number].append((-value, pair))
    return {pair for pairs in of_photo.values() for _, pair in sorted(pairs)[:MOST_ALIKE]}


def near_in_tree(alike: Alike) -> set[tuple[int, int]]:
    """Return the pairs few steps apart in the spanning tree of the most alike pairs."""
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import minimum_spanning_tree, shortest_path

    numbers = sorted({number for pair in alike for number in pair})
    index = {number: k for k, number in enumerate(numbers)}
    ends = [index[a] for a, _ in alike], [index[b] for _, b in alike]
    # Zero would mean no edge.
    apart = np.array([1.0 + 1e-9 - value for value in alike.values()])
    tree = minimum_spanning_tree(csr_matrix((apart, ends), shape=(len(numbers), len(numbers))))
    steps = shortest_path(tree, directed=False, unweighted=True)
    return {pair for pair in alike if steps[index[pair[0]], index[pair[1]]] <= TREE_STEPS}


# -- The helper process: feature extraction, matching, mapping, triangulation ---------------------
#
# Reads ``task.json``, ``images/`` and ``masks/`` of its folder, writes ``model/`` (COLMAP
# binary), and ``turntable.json``, ``turning/`` and ``solution.json`` where it solves.

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
    run = {"solve": _solve, "panoramas": _solve_panoramas, "triangulate": _triangulate}
    run[task["mode"]](folder, task)


def _added_camera(
    db: Any, model: str, size: tuple[int, int], params: Sequence[float], *, is_known: bool = True
) -> int:
    """Add a camera of width and height to a database; return its number."""
    camera = import_pycolmap().Camera(model=model, width=size[0], height=size[1], params=params)
    camera.has_prior_focal_length = is_known
    return int(db.write_camera(camera))


def _solve(folder: Path, task: dict[str, Any]) -> None:
    pycolmap = import_pycolmap()
    database = folder / "database.db"
    guessed: list[int] = []
    names_of_camera: dict[int, list[str]] = {}
    with pycolmap.Database.open(database) as db:
        for group in task["groups"]:
            width, height, focal_px = group["width"], group["height"], group["focal_px"]
            start_px = focal_px or DEFAULT_FOCAL_FACTORS[0] * max(width, height)
            params = [start_px, width / 2, height / 2, 0.0]
            is_known = focal_px is not None
            number = _added_camera(db, "SIMPLE_RADIAL", (width, height), params, is_known=is_known)
            names_of_camera[number] = group["names"]
            guessed += [] if is_known else [number]
    total = sum(len(names) for names in names_of_camera.values())
    features = _MAX_FEATURES if total <= EXHAUSTIVE_LIMIT else _MAX_FEATURES_MANY
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
        text = f"No two of the {total} photos could be placed relative to each other."
        hint = "Take more photos with more overlap, from a textured object that does not move."
        raise DatasetError(text, hint)
    verdict = check_solution(database, best)
    is_mended = False
    if verdict.is_doubtful:
        best, verdict, is_mended = mended(database, folder, solve, best, verdict)
    said = accounts[-1 if is_mended else 0]
    if said["joined"] or said["mapper"] == "global":  # the incremental mapper has done so
        best.extract_colors_for_all_images(folder / "images")
        best.update_point_3d_errors()
    placed = [best.image(number).name for number in sorted(best.reg_image_ids())]
    said |= {
        **verdict.to_json(placed), "is_doubtful": verdict.is_doubtful, "is_mended": is_mended,
        "pairs_matched": len(task["pairs"]),
    }  # fmt: skip
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
            params = [focal_px, focal_px, side / 2, side / 2]
            names = [f"{view:02d}/{number:06d}.jpg" for number in range(task["panoramas"])]
            names_of_camera[_added_camera(db, "PINHOLE", (side, side), params)] = names
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
    if total <= EXHAUSTIVE_LIMIT:
        return _place_one_by_one(folder, database, task, total, guessed)
    models = place_at_once(database, folder, task["seed"], total)
    model, said = _best_of(folder, database, task, models, "global")
    enough = model is not None and model.num_reg_images() >= _MIN_REGISTERED_SHARE * total
    if enough and not check_solution(database, model).is_doubtful:
        return model, said
    one_by_one, other = _place_one_by_one(folder, database, task, total, guessed)
    if model is None or (
        one_by_one is not None
        and check_solution(database, one_by_one).agreeing > check_solution(database, model).agreeing
    ):
        return one_by_one, other
    return model, said


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
        if task["turntable"] == "auto" and not are_turning(most_inliers(database, names, pairs)):
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
            names_of_camera[_added_camera(db, "PINHOLE", (int(width), int(height)), params)] = names
    extract(folder, database, names_of_camera, task["threads"], _MAX_FEATURES_POSED)
    match(folder, database, task)
    pose_of_name = {p["name"]: np.array(p["cam_from_world"]) for p in task["photos"]}
    with pycolmap.Database.open(database) as db:
        poses = {stored.image_id: pose_of_name[stored.name] for stored in db.read_all_images()}
    emit(fraction=MATCH_END, message="triangulating points")
    solved = _triangulated(database, folder, folder, task["seed"], poses, lambda stored: stored)
    solved.extract_colors_for_all_images(folder / "images")
    _write(folder, solved)


def _write(folder: Path, model: Any) -> None:
    (folder / "model").mkdir()
    model.write_binary(folder / "model")
    emit(fraction=1.0, message="cameras are solved")
