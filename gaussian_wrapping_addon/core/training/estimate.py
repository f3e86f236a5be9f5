# SPDX-License-Identifier: GPL-3.0-or-later
"""Time, memory and disk of a training, before it starts."""

from __future__ import annotations

import dataclasses
import logging
import math
import shutil
import time
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..compiled import is_ready
from ..devices.checks import is_device_failure
from ..errors import ResourceError, UsageError, WrapError
from ..gaussians.model import MIN_START_POINTS, OrientedGaussians
from ..machine import available_memory_bytes
from ..photos.store import PhotoMemory, photo_memory
from ..progress import ReportWarning
from ..render.projection import RawArrays
from ..render.raster import forward_kernel
from ..render.simd import vector_lanes
from ..render.types import ImageGradients, RenderOptions
from ..render.view_renderer import ViewRenderer
from ..scene.camera import Camera
from ..settings import TrainingSettings
from ..stereo.depth_maps import least_divisor
from .adam import adam_rows
from .block_plan import POLISH_ITERATIONS, coarse_settings
from .schedule import Schedule
from .start import start_budget

if TYPE_CHECKING:
    from ..scene.scene import Scene


# -- Rendering speed of this machine, relative to the reference machine of the estimate -----------

_logger = logging.getLogger(__name__)

GAUSSIANS = 4000
SIDE_PX = 160

REFERENCE_S = 0.0060
"""Time of one pass on the machine of the estimate's measurements (2 threads of an AMD EPYC with
AVX-512). One thread took 8.7 ms, the fastest of many passes under load; from that, two threads of
an idle machine are assumed to need 6 ms."""

THREAD_SPEED = 0.4
"""Of one thread relative to the reference machine's two, where no kernel is compiled to time."""

GPU_GAUSSIANS, GPU_SIDE_PX = 100_000, 800
REFERENCE_GPU_S = 0.0047
"""Time of one pass of :func:`gpu_speed` on an NVIDIA H200."""

PASSES = 12
TIME_LIMIT_S = 0.7
"""No pass starts later than this, so that a slow machine is also timed in about a second."""


def renderer_is_compiled() -> bool:
    """Tell whether the training kernels are cached from an earlier run on this machine."""
    renderer = forward_kernel(vector_lanes(), True, False)
    return is_ready(adam_rows) and is_ready(renderer)


def machine_speed(threads: int) -> float:
    """Return how many times faster than the reference machine one fixed view is rendered.

    Forward with depth, and backward, of 4000 Gaussians on 160 x 160 pixels; the median of a few
    passes, since the training would share a busy machine too, excluding the first, which loads the
    kernels.
    """
    gaussians, camera = _scene(GAUSSIANS, SIDE_PX)
    renderer = ViewRenderer()
    options = RenderOptions(sh_degree=1, threads=threads)
    color = np.full((SIDE_PX, SIDE_PX, 3), 1e-3, np.float32)
    depth = np.full((SIDE_PX, SIDE_PX), 1e-3, np.float32)

    def run() -> None:
        renderer.render(gaussians, camera, options).backward(
            ImageGradients(color=color, depth=depth)
        )

    run()
    taken_s: list[float] = []
    begun_s = time.perf_counter()
    for _ in range(PASSES):
        start_s = time.perf_counter()
        run()
        end_s = time.perf_counter()
        taken_s.append(end_s - start_s)
        if end_s - begun_s > TIME_LIMIT_S:
            break
    return REFERENCE_S / float(np.median(taken_s))


def gpu_speed(index: int) -> float:
    """Return how many times faster than the reference GPU a GPU renders one fixed view.

    Forward with depth, and backward, of 100 000 Gaussians on 800 x 800 pixels.

    Raises
    ------
    DeviceError, ResourceError
        The GPU cannot be used, or its memory is full.
    """
    import torch

    from ..render.cuda.device_renderer import free_budget_bytes
    from ..render.cuda.device_view import DeviceView
    from ..render.cuda.kernels import device_kernels

    device = torch.device("cuda", index)
    raw, camera = _scene(GPU_GAUSSIANS, GPU_SIDE_PX)
    tensors = {f.name: torch.from_numpy(getattr(raw, f.name)).to(device) for f in fields(raw)}
    gaussians, options = OrientedGaussians(**tensors), RenderOptions(sh_degree=1)
    kernels, budget = device_kernels(index), free_budget_bytes(device)
    size = (GPU_SIDE_PX, GPU_SIDE_PX)
    color, depth = (torch.full(shape, 1e-3, device=device) for shape in ((*size, 3), size))
    taken_s = []
    for _ in range(PASSES):
        torch.cuda.synchronize(device)
        begun_s = time.perf_counter()
        view = DeviceView(kernels, gaussians, camera, options, budget)
        view.backward([color, None, None, None, depth])
        torch.cuda.synchronize(device)
        taken_s.append(time.perf_counter() - begun_s)
    return REFERENCE_GPU_S / float(np.median(taken_s))


def speeds(threads: int, device: str) -> tuple[float, float]:
    """Return the speeds of the processor and of the GPU that a training runs on (0: of none)."""
    if device == "cpu":
        return (machine_speed(threads) if renderer_is_compiled() else 1.0), 0.0
    try:
        on_gpu = gpu_speed(int(device.partition(":")[2] or 0))
    except (WrapError, RuntimeError) as error:
        if not is_device_failure(error):
            raise
        _logger.warning("%s could not be timed: %s", device, error)
        on_gpu = 1.0  # the training will meet the failure as well, and tell
    return THREAD_SPEED * threads, on_gpu


def _scene(count: int, side_px: int) -> tuple[RawArrays, Camera]:
    """Return flat Gaussians spread over a ball in front of the camera, always the same."""
    random = np.random.Generator(np.random.PCG64(7))
    means = random.normal(size=(count, 3))
    means *= random.uniform(0.8, 1.0, (count, 1)) / np.linalg.norm(means, axis=1, keepdims=True)
    quats = random.normal(size=(count, 4))
    log_scales = np.log(random.uniform(0.01, 0.06, (count, 3)))
    arrays = {
        "means": means,
        "log_scales": log_scales,
        "quats": quats / np.linalg.norm(quats, axis=1, keepdims=True),
        "opacity_logits": random.normal(1.0, 1.5, count),
        "sh": random.normal(0.0, 0.3, (count, 4, 3)),
        "orientation": np.zeros((count, 4)),
        "filter_3d": np.full(count, 0.005),
    }
    cam_from_world = np.eye(4)[:3]
    cam_from_world[2, 3] = 4.0
    camera = Camera(
        "speed", side_px, side_px, 1.6 * side_px, 1.6 * side_px, 0.5 * side_px, 0.5 * side_px,
        cam_from_world,
    )  # fmt: skip
    return RawArrays(**{k: np.ascontiguousarray(v, np.float32) for k, v in arrays.items()}), camera


# -- Estimate time, memory and disk space of a training from photos, settings and the machine -----
#
# The time of an iteration is a constant plus terms per rendered pixel and per Gaussian, summed
# over the schedule with its pyramid levels and growth of the number of Gaussians. The constants
# were fitted (least squares of the relative error) to 35 finished trainings on 2 threads of one
# machine (AMD EPYC): 8 scenes of 14 to 50 photos, 96 to 480 px, caps from 5000 to 120 000
# Gaussians, 22 to 424 s. The estimate was between 0.52 and 1.24 times the measured time; scenes
# with much background take longest per pixel. The reported range covers all of them. On a machine
# with 14 waiting processes (3 trainings of 200 to 300 iterations, speed from its fastest pass)
# the estimate was between 0.45 and 0.69 times the measured time, one of them above the range.

ITERATION_S = 2.06e-3
"""Per iteration, whatever its size."""

PIXEL_S = 0.75e-6
"""Per pixel of an iteration with isosurface depth: rendering, losses and their gradients. With this
and the figures below, 3000 iterations on 40 photos of 640 x 480 px are estimated at 284 s; they
took 335 s on two cores with a little other load (benchmarks/scenes wheel, preset standard)."""

WITHOUT_DEPTH = 0.45
"""Share of :data:`PIXEL_S` before depth is rendered (benchmarks/kernels.py: depth adds 105 to
141 % to rendering 50 000 Gaussians forward at up to 800 x 600 px, and the normal losses come with
it)."""

GAUSSIAN_S = 0.254e-6
"""Per Gaussian and iteration: projection, and the step of visible ones."""

MULTI_VIEW_SHARE = 0.4
"""Additional time of a multi-view iteration, as a share of a plain one (57 ms against 144 ms of one
thread, 40 000 Gaussians, 4000 pixels)."""

GPU_ITERATION_S, GPU_PIXEL_S, GPU_GAUSSIAN_S = 5.0e-3, 1.4e-9, 5.5e-9
"""On the reference GPU, an NVIDIA H200: of an iteration with all losses, per pixel, per Gaussian
(fitted to the three cases of benchmarks/cuda_training.py in docs/cuda.md; 3000 iterations on fox
took 18 s without their trials, 19 s by these)."""

GPU_GAUSSIAN_BYTES, GPU_PIXEL_BYTES, GPU_BASE_BYTES = 2400, 200, 300 * 2**20
"""Of GPU memory: values, moments, gradients, a snapshot and tile intersections of a Gaussian;
images and losses of a pixel; the rest. An iteration on 1,000,000 Gaussians and 1920 x 1080 px took
1.79 GiB (docs/cuda.md), to which the snapshot of 0.66 GiB is added."""

MATCHING_PIXEL_S = 6e-6
"""Per pixel of all photos at the size at which they are matched for a dense start: 7.6 us of one
thread (35 photos of 320 x 240 px, benchmarks/scenes wheel) on two threads, and 2 us for planes
through plain parts (0.8 to 5.1 us on 15 scenes of the zoo)."""

MATCHING_PIXEL_BYTES = 200
"""Per such pixel: planes, costs, and the points that are fused."""

LOW, HIGH = 0.75, 1.95
"""The reported range is the model's time times these: it covers every measured training."""

MESH_AND_TEXTURE_SHARE = (0.2, 0.9)
"""Time of meshing and texture, as a share of the training before them: from 17 to 94 % in jobs
on real photos and on benchmarks/scenes, with one region of about 50 thousand faces. Long
trainings have the small shares."""

ROUND_GROWTH = 1.8
"""Growth of the number of Gaussians per densification, up to the budget (measured: 1.55 to 1.87 in
the first one)."""

LITTLE_GROWTH = 0.4
"""Least share of the room for growth that is used where Gaussians are pruned."""

BASE_BYTES = 520 * 2**20
"""Python with torch, scipy and the compiled kernels. With this, a training of 8000 Gaussians at 96
px was estimated at 533 MiB and took 531 MiB. Whole jobs of 40 small photos took 0.7 to 1.4 GB: mesh
and texture need more than a small training."""

GAUSSIAN_COPIES = 8
"""Parameters, two moments, two snapshots, a checkpoint being written."""

PIXEL_BYTES = 250
"""Images, their gradients, contributor lists, losses."""

RENDER_GAUSSIAN_BYTES = 600
"""Screen parameters, tile intersections and their gradients."""

MEMORY_SHARE_LEFT = 0.9
"""Beyond this share of the free memory the system may swap or kill the process."""

CHECKPOINTS = 3
"""Two are kept, and the third is written before the oldest is removed."""

RESULT_BYTES_PER_GAUSSIAN = 500
"""Trained Gaussians and the result's PLY."""

OTHER_DISK_BYTES = 60 * 2**20
"""Pictures, report, mesh and texture of one region."""

DISK_RESERVE_BYTES = 100 * 2**20


@dataclass(frozen=True)
class SceneFacts:
    """Input properties for the estimate."""

    photos: int
    pixels: float
    """Mean number of pixels of the photos on disk."""
    long_side_px: int
    """Long side of the largest photo."""
    points: int
    """Number of sparse points; 0 if not known yet."""
    masked: bool = False


@dataclass(frozen=True)
class Machine:
    """Machine properties for the estimate; 0 bytes if unknown."""

    speed: float = 1.0
    """Relative to the reference machine (:func:`~.estimate.machine_speed`)."""
    memory_bytes: int = 0
    """Memory available now."""
    disk_free_bytes: int = 0
    gpu_speed: float = 0.0
    """Of the GPU that trains, relative to the reference GPU; 0: the processor trains."""


@dataclass(frozen=True)
class Estimate:
    """Estimated cost of a training."""

    seconds_low: float
    seconds_high: float
    memory_bytes: int
    """Largest resident size of the worker."""
    disk_bytes: int
    gaussians: int
    """Largest number of Gaussians."""
    photos: PhotoMemory
    """Whether photos stay in memory."""

    def span(self) -> str:
        """Return the range of the time in suitable units."""
        low, high = self.seconds_low, self.seconds_high
        if high < 90:
            return f"{max(1, round(low))} to {max(1, round(high))} s"
        if high < 5400:
            return f"{max(1, round(low / 60))} to {round(high / 60)} min"
        return f"{low / 3600:.1f} to {high / 3600:.1f} h"

    def sentence(self) -> str:
        """Return the estimate in one line."""
        return (
            f"{self.span()}, {self.memory_bytes / 2**30:.1f} GB of memory, "
            f"{self.disk_bytes / 2**30:.2f} GB of disk, up to {self.gaussians} Gaussians, "
            f"photos {self.photos.sentence()}"
        )


def scene_facts(scene: Scene) -> SceneFacts:
    """Return the properties of a loaded scene."""
    sizes = [(v.camera.width, v.camera.height) for v in scene.views]
    return SceneFacts(
        len(sizes),
        sum(w * h for w, h in sizes) / max(1, len(sizes)),
        max((max(size) for size in sizes), default=0),
        len(scene.points),
        any(view.mask_path is not None for view in scene.views),
    )


def this_machine(folder: Path, speed: float = 1.0, gpu_speed: float = 0.0) -> Machine:
    """Return the resources free now; disk space is that of ``folder``, which need not exist yet."""
    existing = folder
    while not existing.exists() and existing != existing.parent:
        existing = existing.parent
    try:
        free_bytes = shutil.disk_usage(existing).free
    except OSError:
        free_bytes = 0
    return Machine(speed, available_memory_bytes(), free_bytes, gpu_speed)


def gaussian_counts(facts: SceneFacts, settings: TrainingSettings, growth: float) -> np.ndarray:
    """Return the (iterations + extra,) expected numbers of Gaussians.

    Parameters
    ----------
    growth : float
        Share of the room between initial number and limit that is filled.
    """
    schedule = _schedule(facts, settings)
    limit = schedule.growth_limit()
    start = min(limit, max(facts.points, MIN_START_POINTS))
    if settings.dense_start != "off" and facts.photos > 1:
        start = max(start, start_budget(limit))
    top = float(start)
    if settings.growth != "off":
        top = start + growth * (limit - start) if settings.prune_share > 0.0 else limit
    total = settings.iterations + settings.extra_iterations
    counts = np.empty(total)
    count = float(start)
    for iteration in range(total):
        counts[iteration] = count
        done = iteration + 1
        if done >= settings.iterations:
            continue
        if schedule.densifies(done):
            count = max(count, min(top, schedule.budget(done), count * ROUND_GROWTH))
        if settings.wrapping == "on" and schedule.wraps(done):
            count = min(settings.max_gaussians, count * (1.0 + settings.wrap_share))
    return counts


def _schedule(facts: SceneFacts, settings: TrainingSettings) -> Schedule:
    return Schedule(settings, max(1, min(facts.long_side_px, settings.max_image_px)))


def _trained_pixels(facts: SceneFacts, settings: TrainingSettings) -> float:
    """Return the pixels of a photo at the finest training size."""
    factor = min(1.0, settings.max_image_px / max(1, facts.long_side_px))
    return facts.pixels * factor * factor


def _seconds(
    facts: SceneFacts, settings: TrainingSettings, counts: np.ndarray, first: int, on_gpu: bool
) -> float:
    """Return the modelled time on the reference machine or GPU, from iteration ``first`` on."""
    schedule, pixels = _schedule(facts, settings), _trained_pixels(facts, settings)
    compares = settings.multi_view != "off" and facts.photos > 1
    total_s = 0.0
    for iteration, count in enumerate(counts[first:].tolist(), first):
        planned = min(iteration, settings.iterations - 1)
        size = _window(pixels / schedule.divisor(planned) ** 2, settings.pixels_per_iteration)
        if on_gpu:
            total_s += GPU_ITERATION_S + size * GPU_PIXEL_S + count * GPU_GAUSSIAN_S
            continue
        depth = schedule.uses_depth(planned)
        spent_s = size * PIXEL_S * (1.0 if depth else WITHOUT_DEPTH) + count * GAUSSIAN_S
        if compares and schedule.compares_views(planned):
            spent_s *= 1.0 + MULTI_VIEW_SHARE
        total_s += ITERATION_S + spent_s
    return total_s


def _matched_pixels(facts: SceneFacts, settings: TrainingSettings) -> float:
    """Return the pixels of all photos at the size at which they are matched."""
    if settings.dense_start == "off":
        return 0.0
    side = min(facts.long_side_px, settings.max_image_px)
    pixels = facts.photos * _trained_pixels(facts, settings)
    return pixels / least_divisor(side, pixels, settings.match_px) ** 2


def _window(pixels: float, most: int) -> float:
    """Return the approximate number of pixels of a window (:mod:`.backend`)."""
    across = math.ceil(math.sqrt(pixels / most))
    return pixels / across**2 if across > 1 else pixels


def estimate(
    scene_facts: SceneFacts, settings: TrainingSettings, machine: Machine, *, first: int = 0
) -> Estimate:
    """Estimate the cost of a training in one piece, from iteration ``first`` of a checkpoint on.

    For settings left to the photos (``"auto"``), the range extends from "off" to "on". Times are
    those of the training alone, without camera poses, meshing and texture
    (:data:`MESH_AND_TEXTURE_SHARE`).
    """
    decided = settings.multi_view == "auto"
    cheap = dataclasses.replace(settings, multi_view="off") if decided else settings
    least = gaussian_counts(scene_facts, settings, LITTLE_GROWTH)
    most = gaussian_counts(scene_facts, settings, 1.0)
    matched = _matched_pixels(scene_facts, settings)
    matching_s = MATCHING_PIXEL_S * matched if first == 0 else 0.0
    if machine.gpu_speed:
        iterating = [_seconds(scene_facts, settings, c, first, True) for c in (least, most)]
        low_s = LOW * (iterating[0] / machine.gpu_speed + matching_s / machine.speed)
        high_s = HIGH * (iterating[1] / machine.gpu_speed + matching_s / machine.speed)
    else:
        low_s = _seconds(scene_facts, cheap, least, first, False)
        high_s = _seconds(scene_facts, settings, most, first, False)
        low_s = LOW * (low_s + matching_s) / machine.speed
        high_s = HIGH * (high_s + matching_s) / machine.speed
    count = math.ceil(float(most.max()))
    value_bytes = gaussian_bytes(settings)
    state_bytes = 3 * value_bytes + 20  # with both moments, filter, steps, statistics
    pixels = _trained_pixels(scene_facts, settings)
    photos = photo_memory(
        scene_facts.photos, pixels, masked=scene_facts.masked, free_bytes=machine.memory_bytes
    )
    memory = (
        BASE_BYTES
        + count * (value_bytes * GAUSSIAN_COPIES + RENDER_GAUSSIAN_BYTES)
        + pixels * PIXEL_BYTES
        + photos.used_bytes
        + matched * MATCHING_PIXEL_BYTES
    )
    disk = CHECKPOINTS * count * state_bytes + count * RESULT_BYTES_PER_GAUSSIAN
    disk_bytes = round(disk) + OTHER_DISK_BYTES
    return Estimate(low_s, high_s, round(memory), disk_bytes, count, photos)


def gaussian_bytes(settings: TrainingSettings) -> int:
    """Return the bytes of the values of a Gaussian that are trained."""
    coefficients = 3 * (settings.sh_degree + 1) ** 2
    return 4 * (3 + 3 + 4 + 1 + coefficients + 4)


def gpu_bytes(facts: SceneFacts, settings: TrainingSettings, gaussians: int) -> int:
    """Return the GPU memory that a training needs at most."""
    pixels = _window(_trained_pixels(facts, settings), settings.pixels_per_iteration)
    return round(gaussians * GPU_GAUSSIAN_BYTES + pixels * GPU_PIXEL_BYTES) + GPU_BASE_BYTES


def check_resources(expected: Estimate, machine: Machine) -> list[ReportWarning]:
    """Check disk space and memory; return warnings about memory.

    Raises
    ------
    ResourceError
        The disk has less free space than the training will write.
    """
    if machine.disk_free_bytes and expected.disk_bytes > machine.disk_free_bytes:
        missing = expected.disk_bytes + DISK_RESERVE_BYTES - machine.disk_free_bytes
        raise ResourceError(
            f"The training will write {expected.disk_bytes / 2**30:.2f} GB, and only "
            f"{machine.disk_free_bytes / 2**30:.2f} GB are free where the job lies.",
            f"Free {missing / 2**30:.2f} GB there, choose another --out, or set fewer "
            "--max-gaussians; then resume.",
        )
    if machine.memory_bytes and expected.memory_bytes > MEMORY_SHARE_LEFT * machine.memory_bytes:
        text = (
            f"The training may need {expected.memory_bytes / 2**30:.1f} GB of memory, and only "
            f"{machine.memory_bytes / 2**30:.1f} GB are free: close other programs, or set fewer "
            "--max-gaussians or a smaller --max-image-px."
        )
        return [ReportWarning("memory-short", text)]
    return []


# -- Estimate the cost of a training in blocks: coarse training, one block, joining ---------------

PHOTOS_OVERLAP = 1.6
"""A block takes about so many times its share of the photos: those of its margin, and those that
look into it from outside."""

MARGIN_GAUSSIANS = 1.4
"""Gaussians of a block with its margin, as a multiple of those in its cell: 0.2 of the cell's size
along two axes, on one side each for the four blocks of a square."""


def estimate_training(
    facts: SceneFacts, settings: TrainingSettings, machine: Machine, *, first: int = 0
) -> Estimate:
    """Estimate the cost of a training, in blocks or in one piece; see :func:`estimate`.

    Of blocks: the time of all of them together, one after another, and the memory of the largest
    process.

    Raises
    ------
    UsageError
        There are more blocks than photos: told before the coarse training, not after it.
    """
    if settings.blocks == 1:
        return estimate(facts, settings, machine, first=first)
    if settings.blocks > facts.photos:
        raise UsageError(
            f"The training cannot be divided into {settings.blocks} blocks: "
            f"{facts.photos} photos.", "Choose fewer blocks.",
        )  # fmt: skip
    parts = block_estimates(facts, settings, machine)
    count = [1, settings.blocks, 1]
    return Estimate(
        sum(n * part.seconds_low for n, part in zip(count, parts, strict=True)),
        sum(n * part.seconds_high for n, part in zip(count, parts, strict=True)),
        max(part.memory_bytes for part in parts),
        sum(n * part.disk_bytes for n, part in zip(count, parts, strict=True)),
        settings.max_gaussians,
        parts[2].photos,
    )


def block_estimates(
    facts: SceneFacts, settings: TrainingSettings, machine: Machine
) -> tuple[Estimate, Estimate, Estimate]:
    """Return the estimates of the coarse training, of one block, and of joining all."""
    share = min(1.0, PHOTOS_OVERLAP / settings.blocks)
    photos = dataclasses.replace(
        facts,
        photos=max(1, math.ceil(share * facts.photos)),
        points=math.ceil(facts.points / settings.blocks),
    )
    of_block = dataclasses.replace(
        settings,
        iterations=max(1, round(share * settings.iterations)),
        extra_iterations=0,
        max_gaussians=gaussians_of_block(settings),
        dense_start="off",
    )
    further = settings.extra_iterations + round(POLISH_ITERATIONS * settings.iterations)
    joined = estimate(
        facts, dataclasses.replace(settings, extra_iterations=further, dense_start="off"), machine,
        first=settings.iterations,
    )  # fmt: skip
    coarse = estimate(facts, coarse_settings(settings), machine)
    return coarse, estimate(photos, of_block, machine), joined


def gaussians_of_block(settings: TrainingSettings) -> int:
    """Return about the largest number of Gaussians that one block trains."""
    return math.ceil(MARGIN_GAUSSIANS * settings.max_gaussians / settings.blocks)
