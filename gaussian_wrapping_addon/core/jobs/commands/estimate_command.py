# SPDX-License-Identifier: GPL-3.0-or-later
"""The ``estimate`` command in the worker's Python: time, memory and disk of a training."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

from ...devices import choose_device
from ...errors import DatasetError
from ...files import real_path
from ...progress import ReportWarning
from ...settings import JobSettings
from ..store.job_file import JobFile
from .run_in_worker import run_command

if TYPE_CHECKING:
    from ...training.estimate import SceneFacts


def main(arguments: list[str]) -> int:
    """Estimate the job of ``arguments = [job file as JSON]``; return the exit code."""
    return run_command(lambda: _estimate(JobFile.from_json(json.loads(arguments[0]))))


def _estimate(job: JobFile) -> list[str | ReportWarning]:
    from ...parallel import default_threads
    from ...training import estimate
    from ...training.splat_start import wrapping_settings
    from ..stages.cameras import start_splat_of

    facts = input_facts(Path(job.source), job.settings)
    device = choose_device(job.settings.device)
    training = job.settings.training
    if start_splat_of(job) is not None:
        training = wrapping_settings(training)
    threads = job.settings.threads or default_threads()
    timed = device.is_cuda or estimate.renderer_is_compiled()
    machine = estimate.this_machine(Path.cwd(), *estimate.speeds(threads, device.device))
    expected = estimate.estimate_training(facts, training, machine)
    low, high = estimate.MESH_AND_TEXTURE_SHARE
    points = f"{facts.points} sparse points" if facts.points else "camera poses still to be solved"
    where = device.card if device.is_cuda else f"{threads} threads"
    lines = [
        f"{facts.photos} photos, long side {facts.long_side_px} px, {points}",
        f"training ({job.settings.preset}, {where}): {expected.span()}",
        f"memory: {expected.memory_bytes / 2**30:.1f} GB",
        f"disk: {expected.disk_bytes / 2**30:.2f} GB",
        f"photos: {expected.photos.sentence()}",
        f"Gaussians: up to {expected.gaussians:,}",
        f"mesh and texture: {100 * low:.0f} to {100 * high:.0f} % more",
    ]
    if training.blocks > 1:
        names = ("coarse training", "one block", "joining")
        parts = estimate.block_estimates(facts, training, machine)
        told = [
            f"{name} {part.span()}, {part.memory_bytes / 2**30:.1f} GB"
            for name, part in zip(names, parts, strict=True)
        ]
        lines.append(f"{training.blocks} blocks: {'; '.join(told)}")
    if not facts.points:
        lines.append("solving the cameras: minutes before")
    if not timed:
        lines.append("not timed here: the first job compiles the renderer, about a minute, once")
    return [*lines, *estimate.check_resources(expected, machine)]


def input_facts(source: Path, settings: JobSettings | None = None) -> SceneFacts:
    """Return number and size of an input's photos and points, from headers and poses alone.

    ``settings``: of a video, they may say how many frames are used; else the most is assumed.
    Raises DatasetError: the input holds no photo that can be read.
    """
    from ...loading.other_inputs import FAR_VIEWS, NEAR_VIEWS, PHOTO_SIDE_PX, takes_for_panoramas
    from ...loading.source_kind import SPLAT, VIDEO, read_poses, source_kind
    from ...photos.finder import PhotoIndex, find_mask, list_photos, photo_root
    from ...photos.photo_file import photo_header
    from ...poses.panoramas import VIEWS, view_lens
    from ...readers.point_files import read_splat_header
    from ...training.estimate import SceneFacts
    from ..stages.cameras import MAX_START_POINTS

    kind = source_kind(real_path(source))
    if kind.kind == SPLAT:
        header = read_splat_header(source)
        views = FAR_VIEWS + NEAR_VIEWS
        points = min(header.count, MAX_START_POINTS)
        return SceneFacts(views, float(PHOTO_SIDE_PX**2), PHOTO_SIDE_PX, points)
    if kind.kind == VIDEO and kind.video is not None:
        return _video_facts(kind.video, settings or JobSettings())
    points, panoramas = 0, False
    if kind.kind == "photos":
        root = photo_root(kind.folder)
        named = {p.relative_to(root).as_posix(): p for p in list_photos(root)}
        mode = (settings or JobSettings()).equirectangular
        panoramas = takes_for_panoramas(list(named.values()), mode)
    else:
        model = read_poses(kind)
        panoramas = any(photo.is_panorama for photo in model.photos)
        points, index = len(model.points), PhotoIndex(kind.photo_roots)
        matches = {photo.name: index.find(photo.name) for photo in model.photos}
        named = {name: match.path for name, match in matches.items() if match is not None}
    sizes = []
    for path in named.values():
        try:
            sizes.append(photo_header(path).upright_size)
        except DatasetError:
            continue  # loading leaves it out with a warning, or raises
    if not sizes:
        raise DatasetError(
            f"{source} holds no photo that can be read.", "See what batch.py check finds."
        )
    if panoramas:
        lenses = [view_lens(width) for width, _ in sizes]
        sizes = [(lens.width, lens.height) for lens in lenses for _ in VIEWS]
    return SceneFacts(
        len(sizes),
        sum(width * height for width, height in sizes) / len(sizes),
        max(max(size) for size in sizes),
        points,
        any(find_mask(kind.mask_roots, name, kind.photo_roots) is not None for name in named),
    )


def _video_facts(video: Path, settings: JobSettings) -> SceneFacts:
    """Return the most photos that a video may give, and their size."""
    from ...photos.video import probed
    from ...photos.video_frames import MOST_FRAMES
    from ...training.estimate import SceneFacts

    found = probed(video)
    count = settings.video_frames
    if not count and settings.video_fps and found.duration_s:
        count = round(found.duration_s * settings.video_fps)
    count = count or MOST_FRAMES
    count = max(min(count, found.frames) if found.frames else count, 1)
    return SceneFacts(count, float(found.width * found.height), max(found.width, found.height), 0)
