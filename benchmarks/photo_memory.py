# SPDX-License-Identifier: GPL-3.0-or-later
"""Does memory grow with the photos, and what do photos cost that do not fit into memory?

``python -m benchmarks.photo_memory FOLDER`` writes JPEGs of 12 megapixels: a few rendered pictures
of a box, each of them several times with the same camera. Loading, a training that comes to every
photo, and a texture run in processes of their own for each number of photos, with the same memory
for photos; the table shows their peaks and what a photo more adds. The dense start is left out: it
matches photos at a size that falls with their number, in the same memory for all numbers.

``--speed`` asks for photos as iterations do, in random order round by round and each with one to
compare it with, and with memory for a quarter of them: the others are kept decoded on disk, as in
trainings, or are decoded each time, or the photo used longest ago makes room for the next.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import json
import os
import shutil
import subprocess
import sys
import time
from collections import OrderedDict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import numpy as np

from gaussian_wrapping_addon.core.dataset.loading.load import load_scene
from gaussian_wrapping_addon.core.dataset.photos.kept_photos import Key
from gaussian_wrapping_addon.core.dataset.photos.photo_store import PhotoStore
from gaussian_wrapping_addon.core.dataset.scene import Scene
from gaussian_wrapping_addon.core.dataset.scene_file import load_saved_scene, save_scene
from gaussian_wrapping_addon.core.files import write_json
from gaussian_wrapping_addon.core.gaussians.gaussian_file import save_gaussians
from gaussian_wrapping_addon.core.limits import MAX_IMAGE_SIDE_PX
from gaussian_wrapping_addon.core.mesh.surface_mesh import SurfaceMesh
from gaussian_wrapping_addon.core.processes.peak_memory import own_peak_bytes
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.settings import TextureSettings, TrainingSettings, preset
from gaussian_wrapping_addon.core.texture.texture_mesh import texture_mesh
from gaussian_wrapping_addon.core.training.trainer import train

from .large_photos import BOX_HALF_M, make_scene
from .tables import Table

PHASES = ("load", "train", "texture")
MODES = ("memory", "disk", "files", "oldest")
SPEED_SIDE_PX = 1600
ROUNDS = 3
"""After a first one, in which each photo is decoded."""
_MIB = 2**20


@dataclasses.dataclass(frozen=True)
class Run:
    """What a process does, and where."""

    folder: Path
    photos: int
    side_px: int
    budget_mib: int
    threads: int

    @property
    def work(self) -> Path:
        """Folder of results."""
        return self.folder / f"work-{self.photos}-{self.side_px}"

    def scene(self) -> Scene:
        """Return the scene that was loaded."""
        return load_saved_scene(self.work / "load")

    def phase(self, name: str) -> None:
        """Do a phase in this process."""
        target = self.work / name
        shutil.rmtree(target, ignore_errors=True)
        target.mkdir(parents=True)
        known: dict[str, Any] = {"threads": self.threads}
        budget = self.budget_mib * _MIB
        if name == "load":
            source = make_scene(self.folder, self.photos, self.side_px)
            save_scene(load_scene(source, target, Progress(), **known), target)
        elif name == "train":
            scene = self.scene()
            photos = PhotoStore(scene, self.side_px, memory_bytes=budget)
            settings = dataclasses.replace(_settings(self.side_px), iterations=2 * self.photos)
            result = train(scene, photos, settings, target, Progress(), **known)
            save_gaussians(target / "gaussians.npz", result.gaussians)
        else:
            scene = self.scene()
            photos = PhotoStore(scene, MAX_IMAGE_SIDE_PX, memory_bytes=budget)
            asked = TextureSettings(size_px=1024)
            texture_mesh(box_mesh(scene), scene, photos, asked, target, Progress(), **known)
        write_json(target / "figures.json", {"peak_bytes": own_peak_bytes()})

    def accesses(self, mode: str) -> dict[str, float]:
        """Return the time of an access and how many were decoded, after the first round."""
        scene, target = self.scene(), self.work / mode
        target.mkdir(parents=True, exist_ok=True)
        count = len(scene.views)
        one = SPEED_SIDE_PX * (SPEED_SIDE_PX * 3 // 4) * 3
        limit = count * one if mode == "memory" else count * one // 4
        photos = (_OldestGoes if mode == "oldest" else _Counted)(
            scene, SPEED_SIDE_PX, memory_bytes=limit
        )
        random = np.random.default_rng(0)
        begun_s, cpu_s = 0.0, 0.0
        with contextlib.ExitStack() as kept:
            if mode == "disk":
                kept.enter_context(photos.decoded_in(target))
            for turn in range(1 + ROUNDS):
                if turn == 1:
                    photos.decoded = 0
                    begun_s, cpu_s = time.perf_counter(), time.process_time()
                for index in random.permutation(count).tolist():
                    photos.photo(index)
                    photos.photo((index + 1 + int(random.integers(3))) % count)
            accesses = 2 * ROUNDS * count
            return {
                "wall_ms": 1000 * (time.perf_counter() - begun_s) / accesses,
                "cpu_ms": 1000 * (time.process_time() - cpu_s) / accesses,
                "decoded": photos.decoded / accesses,
            }


def _settings(side_px: int) -> TrainingSettings:
    return dataclasses.replace(
        preset("standard").training,
        max_image_px=side_px, max_gaussians=20_000, full_size="on", multi_view="on",
        harmonics="off", wrapping="off", preview_every_s=0.0, dense_start="off",
        # Rounds and held-out photos render whole views: long, and the same for all numbers.
        growth="off", prune_share=0.0, holdout_every=0,
    )  # fmt: skip


def box_mesh(scene: Scene) -> SurfaceMesh:
    """Return the box, scene frame."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    faces = [face for a, b, c, d in quads for face in ((a, b, c), (a, c, d))]
    vertices = scene.world_from_scene.inverse().points(BOX_HALF_M * corners)
    return SurfaceMesh(vertices, np.array(faces, np.int32))


class _Counted(PhotoStore):
    """Counts the photos that it decodes."""

    def __init__(self, scene: Scene, max_image_px: int, *, memory_bytes: int) -> None:
        super().__init__(scene, max_image_px, memory_bytes=memory_bytes)
        self.decoded = 0

    def _make_photo(self, index: int, divisor: int) -> np.ndarray:
        self.decoded += divisor == 1
        return super()._make_photo(index, divisor)


class _OldestGoes(_Counted):
    """As before 2026-11-26: the array used longest ago makes room for the next one."""

    def __init__(self, scene: Scene, max_image_px: int, *, memory_bytes: int) -> None:
        super().__init__(scene, max_image_px, memory_bytes=memory_bytes)
        self._arrays: OrderedDict[Key, np.ndarray] = OrderedDict()
        self._left = memory_bytes

    def _array(self, key: Key, make: Callable[[], np.ndarray]) -> np.ndarray:
        if key in self._arrays:
            self._arrays.move_to_end(key)
            return self._arrays[key]
        self._arrays[key] = array = make()
        self._left -= array.nbytes
        while self._left < 0 and len(self._arrays) > 1:
            self._left += self._arrays.popitem(last=False)[1].nbytes
        return array


def memory_table(runs: Sequence[Run], peaks: dict[tuple[str, int], int]) -> Table:
    """Return the peaks of the phases and what a photo adds."""
    few, many = runs
    rows: list[tuple[Any, ...]] = []
    for phase in PHASES:
        low, high = (peaks[phase, run.photos] / _MIB for run in runs)
        rows.append(
            (phase, round(low), round(high), round((high - low) / (many.photos - few.photos), 2))
        )
    decoded = 3 * few.side_px * (few.side_px * 3 // 4) / _MIB
    return Table(
        "Peak memory",
        ("phase", f"{few.photos} photos MiB", f"{many.photos} photos MiB", "MiB a photo more"),
        rows,
        (
            f"Photos of {few.side_px} x {few.side_px * 3 // 4} px, {decoded:.0f} MiB decoded.",
            f"{few.budget_mib} MiB of memory for photos in training and texture.",
        ),
    )


def speed_table(run: Run) -> Table:
    """Return what an access takes in each mode."""
    names = ("all in memory", "decoded on disk", "decoded again", "decoded again, oldest goes")
    rows: list[tuple[Any, ...]] = []
    for mode, name in zip(MODES, names, strict=True):
        found = run.accesses(mode)
        rows.append(
            (
                name, round(found["cpu_ms"], 1), round(found["wall_ms"], 1),
                round(100 * found["decoded"]),
            )
        )  # fmt: skip
    return Table(
        "An access",
        ("photos", "processor ms", "wall ms", "decoded %"),
        rows,
        (
            f"{run.photos} photos of {run.side_px} px at {SPEED_SIDE_PX} px, {ROUNDS} rounds.",
            "In all rows but the first there is memory for a quarter of them.",
        ),
    )


def main(given: Sequence[str] | None = None, say: Callable[[str], object] = print) -> int:
    """Run what was asked for in child processes and print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.photo_memory", description=__doc__)
    parser.add_argument("folder", type=Path, help="photos and results; made if missing")
    parser.add_argument("--photos", type=int, nargs=2, default=(16, 48))
    parser.add_argument("--side", type=int, default=4000, help="of photos, pixels")
    parser.add_argument("--budget", type=int, default=512, help="memory for photos, MiB")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--speed", action="store_true", help="time accesses to the fewer photos")
    parser.add_argument("--step", help=argparse.SUPPRESS)  # of one child process
    words = list(sys.argv[1:] if given is None else given)
    asked = parser.parse_args(words)
    runs = [
        Run(asked.folder, photos, asked.side, asked.budget, asked.threads)
        for photos in asked.photos
    ]
    if asked.step:
        name, _, which = asked.step.partition(":")
        runs[int(which)].phase(name)
        return 0
    for run in runs:
        make_scene(asked.folder, run.photos, asked.side)  # not in a process that is measured
    if asked.speed:
        steps = ["load:0"]
    else:
        steps = [f"{name}:{which}" for which in (0, 1) for name in PHASES]
    for step in steps:
        command = [sys.executable, "-m", "benchmarks.photo_memory", *words, "--step", step]
        code = subprocess.run(command, check=False).returncode
        if code:
            say(f"{step} failed with exit code {code}")
            return 1
    if asked.speed:
        say(speed_table(runs[0]).markdown())
        return 0
    peaks = {
        (phase, run.photos): json.loads((run.work / phase / "figures.json").read_text())[
            "peak_bytes"
        ]
        for run in runs
        for phase in PHASES
    }
    say(memory_table(runs, peaks).markdown())
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
