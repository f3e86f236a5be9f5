# SPDX-License-Identifier: GPL-3.0-or-later
"""Blocks against one training, on photos of a town's streets: ``python -m benchmarks.blocks``.

Each step (the whole training; the coarse one with its plan; each block; joining) runs in a process
of its own, which reports its processor time and peak memory. Both results have the same limit of
Gaussians and are judged by the photos held out, whole and where they show what lies near a border
between blocks. A step that has its result is not run again.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import numpy as np

from gaussian_wrapping_addon.core.dataset.camera import Camera
from gaussian_wrapping_addon.core.dataset.loading.load import load_scene
from gaussian_wrapping_addon.core.dataset.photos.photo_store import PhotoStore
from gaussian_wrapping_addon.core.dataset.refined_scene import with_poses
from gaussian_wrapping_addon.core.dataset.scene import Scene
from gaussian_wrapping_addon.core.dataset.view_split import held_out_views
from gaussian_wrapping_addon.core.files import write_json
from gaussian_wrapping_addon.core.gaussians.gaussian_file import load_gaussians, save_gaussians
from gaussian_wrapping_addon.core.processes.peak_memory import own_peak_bytes
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.render.projection.projection import RawArrays
from gaussian_wrapping_addon.core.render.types.options import RenderOptions
from gaussian_wrapping_addon.core.render.view_renderer import ViewRenderer
from gaussian_wrapping_addon.core.settings import TrainingSettings, preset
from gaussian_wrapping_addon.core.training.blocks.block_plan import BlockPlan
from gaussian_wrapping_addon.core.training.blocks.block_settings import BlockSettings
from gaussian_wrapping_addon.core.training.blocks.coarse_training import (
    confirmed_depths,
    train_coarse,
)
from gaussian_wrapping_addon.core.training.blocks.join_blocks import join_blocks
from gaussian_wrapping_addon.core.training.blocks.plan_blocks import plan_blocks
from gaussian_wrapping_addon.core.training.blocks.plan_file import load_plan, save_plan
from gaussian_wrapping_addon.core.training.blocks.train_block import train_block
from gaussian_wrapping_addon.core.training.trainer import train

from .camera_solving.places import town
from .camera_solving.ray_caster import Boxes, render
from .scenes.colmap_project import write_colmap
from .scenes.sparse_points import SparsePoints
from .tables import Table

POINTS_PER_PHOTO = 60
"""Sparse points that are tried; those that two photos see are kept."""

BAND_SHARE = 0.5
"""A pixel is near a border if its surface lies within this share of the smallest margin."""

_RESULT = "gaussians.npz"


def make_scene(folder: Path, photos: int, width: int, threads: int) -> Path:
    """Write a COLMAP project of the town in a new folder, unless it is there; return it."""
    target = folder / f"town-{photos}-{width}"
    if target.is_dir():
        return target
    making = target.with_name(f"{target.name}.making")
    (making / "images").mkdir(parents=True, exist_ok=True)
    place = town(photos)
    cameras = [c.resized(width, round(width * c.height / c.width)) for c in place.cameras]
    cameras = [dataclasses.replace(c, name=f"{Path(c.name).stem}.png") for c in cameras]
    images = []
    for camera in cameras:
        from PIL import Image

        images.append(render(place.boxes, camera, threads=threads))
        Image.fromarray(images[-1]).save(making / "images" / camera.name)
    sparse = seen_points(place.boxes, cameras, images, POINTS_PER_PHOTO * photos)
    write_colmap(making / "sparse" / "0", cameras, sparse)
    making.rename(target)
    return target


def seen_points(
    boxes: Boxes, cameras: Sequence[Camera], images: Sequence[np.ndarray], count: int
) -> SparsePoints:
    """Return random points of the boxes' faces that at least two photos see, with exact tracks."""
    random = np.random.default_rng(0)
    size = boxes.upper - boxes.lower
    areas = np.stack([size[:, (a + 1) % 3] * size[:, (a + 2) % 3] for a in range(3)], 1)
    shares = np.repeat(areas, 2, 1).reshape(-1) / (2.0 * areas.sum())
    face = random.choice(len(shares), count, p=shares)
    box, side = face // 6, face % 6
    inside = random.random((count, 3))
    inside[np.arange(count), side // 2] = side % 2
    points = boxes.lower[box] + inside * size[box]
    found: list[tuple[int, int, np.ndarray]] = []
    colors = np.zeros((count, 3), np.uint8)
    for index, camera in enumerate(cameras):
        pixels, depth = camera.project(points)
        shown = (depth > 0.1) & (pixels >= 1).all(1)
        shown &= (pixels < (camera.width - 1, camera.height - 1)).all(1)
        rows = np.flatnonzero(shown)
        rows = rows[_in_sight(boxes, camera.center, points[rows])]
        at = pixels[rows].astype(np.int64)
        colors[rows] = images[index][at[:, 1], at[:, 0]]
        found += [(row, index, pixels[row]) for row in rows.tolist()]
    seen = np.bincount([row for row, _, _ in found], minlength=count)
    number = np.cumsum(seen >= 2) - 1
    kept = sorted((number[row], view, pixel) for row, view, pixel in found if seen[row] >= 2)
    return SparsePoints(
        points[seen >= 2], colors[seen >= 2], np.zeros(int((seen >= 2).sum())),
        np.array([row for row, _, _ in kept], np.int64),
        np.array([view for _, view, _ in kept], np.int64),
        np.array([pixel for _, _, pixel in kept]).reshape(-1, 2),
    )  # fmt: skip


def _in_sight(boxes: Boxes, eye: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Tell which points nothing stands before; the first box is seen from inside and hides none."""
    way = points - eye
    way = np.where(np.abs(way) < 1e-12, 1e-12, way)[:, None]
    near, far = (boxes.lower[1:] - eye) / way, (boxes.upper[1:] - eye) / way
    first, last = np.minimum(near, far).max(2), np.maximum(near, far).min(2)
    return ~((first < last) & (last > 0.0) & (first < 1.0 - 1e-6)).any(1)


@dataclasses.dataclass(frozen=True)
class Run:
    """One comparison, and where it is."""

    folder: Path
    settings: TrainingSettings
    blocks: BlockSettings
    seed: int
    threads: int
    source: Path

    def scene(self, *, refined: bool = True) -> Scene:
        """Return the scene, with the poses that the coarse training refined or with those given."""
        scene = load_scene(
            self.source, self.folder / "scene", Progress(), seed=self.seed, threads=self.threads
        )
        if refined:
            poses = load_plan(self.folder / "plan").coarse.poses
            return scene if poses is None else with_poses(scene, poses)
        return scene

    def step(self, name: str) -> None:
        """Run a step in this process."""
        folder = self.folder / name
        folder.mkdir(parents=True, exist_ok=True)
        begun_s, cpu_s = time.perf_counter(), time.process_time()
        figures = self._work(name, folder)
        figures |= {
            "cpu_s": time.process_time() - cpu_s,
            "wall_s": time.perf_counter() - begun_s,
            "peak_bytes": own_peak_bytes(),
        }
        write_json(folder / "figures.json", figures)

    def _work(self, name: str, folder: Path) -> dict[str, Any]:
        progress, plans = Progress(), self.folder / "plan"
        known: dict[str, Any] = {"seed": self.seed, "threads": self.threads}
        scene = self.scene(refined=name not in ("whole", "coarse"))
        photos = PhotoStore(scene, self.settings.max_image_px)
        if name == "whole":
            result = train(scene, photos, self.settings, folder, progress, **known)
            save_gaussians(folder / _RESULT, result.gaussians)
            return {"gaussians": len(result.gaussians)}
        coarse_settings = self.blocks.coarse(self.settings)
        coarse_photos = PhotoStore(scene, coarse_settings.max_image_px)
        if name == "coarse":
            coarse = train_coarse(scene, coarse_photos, coarse_settings, folder, progress, **known)
            if coarse.poses is not None:
                scene = with_poses(scene, coarse.poses)
                photos = PhotoStore(scene, self.settings.max_image_px)
            plan = plan_blocks(
                coarse, scene, photos, self.settings, self.blocks, progress, threads=self.threads
            )
            plans.mkdir(exist_ok=True)
            save_plan(plans, plan)
            return {
                "gaussians": len(coarse.gaussians),
                "photos": [len(block.views) for block in plan.blocks],
            }
        plan = load_plan(plans)
        index = int(name.partition("-")[2] or 0)
        views = plan.views if name == "joined" else plan.blocks[index].views
        known["priors"] = confirmed_depths(
            plan.coarse, self.folder / "coarse", coarse_photos, coarse_settings, plan.views, views
        )
        if name == "joined":
            parts = (
                load_gaussians(self.folder / f"block-{k}" / _RESULT)
                for k in range(len(plan.blocks))
            )
            result = join_blocks(
                plan, parts, scene, photos, self.settings, self.blocks, folder, progress, **known
            )
        else:
            result = train_block(
                plan, index, scene, photos, self.settings, folder, progress, **known
            )
        save_gaussians(folder / _RESULT, result.gaussians)
        return {"gaussians": len(result.gaussians)}

    def judged(self) -> dict[str, tuple[float, float, float]]:
        """Return the PSNR of both results: whole photos, near borders, and elsewhere, dB."""
        scene, plan = self.scene(), load_plan(self.folder / "plan")
        photos = PhotoStore(scene, self.settings.max_image_px)
        raw = {
            name: RawArrays.from_gaussians(load_gaussians(self.folder / name / _RESULT))
            for name in ("whole", "joined")
        }
        reach = BAND_SHARE * float(plan.margins[plan.margins > 0.0].min())
        squared: dict[str, list[np.ndarray]] = {name: [] for name in raw}
        near = []
        renderer = ViewRenderer()
        for view in held_out_views(scene, self.settings.holdout_every):
            camera, photo = photos.camera(view), photos.photo(view) / 255.0
            options = RenderOptions(threads=self.threads)
            for name, gaussians in raw.items():
                image = renderer.render(gaussians, camera, options)
                if name == "whole":
                    near.append(near_border(plan, camera, image.depth, reach))
                errors = (np.clip(image.color, 0.0, 1.0) - photo) ** 2
                squared[name].append(errors.mean(2).reshape(-1))
        border = np.concatenate(near)
        found = {}
        for name, parts in squared.items():
            errors = np.concatenate(parts)
            found[name] = (_psnr(errors), _psnr(errors[border]), _psnr(errors[~border]))
        return found


def near_border(plan: BlockPlan, camera: Camera, depth: np.ndarray, reach: float) -> np.ndarray:
    """Tell which pixels show surface within reach of a border between cells, (h * w,) bool."""
    seen = (camera.rays() * depth[..., None]).reshape(-1, 3)
    points = (seen - camera.cam_from_world[:, 3]) @ camera.rotation
    return plan.near_border(points, reach) & (depth.reshape(-1) > 0.0)


def _psnr(squared: np.ndarray) -> float:
    return float(-10.0 * np.log10(max(squared.mean(), 1e-10))) if len(squared) else float("nan")


def tables(run: Run, steps: Sequence[str]) -> list[Table]:
    """Return what each step took, and the quality of both results."""
    figures = {name: json.loads((run.folder / name / "figures.json").read_text()) for name in steps}
    cost = Table(
        "Steps", ("step", "processor s", "peak MiB", "Gaussians"),
        [
            (name, round(of["cpu_s"], 1), round(of["peak_bytes"] / 2**20), of["gaussians"])
            for name, of in figures.items()
        ],
        (f"Photos of the blocks: {figures['coarse']['photos']}.",),
    )  # fmt: skip
    judged = run.judged()
    quality = Table(
        "Held-out photos", ("result", "PSNR dB", "near borders dB", "elsewhere dB"),
        [(name, *(round(value, 2) for value in of)) for name, of in judged.items()],
    )  # fmt: skip
    return [cost, quality]


def main(given: Sequence[str] | None = None, say: Callable[[str], object] = print) -> int:
    """Run all steps that have no result yet and print the tables."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.blocks", description=__doc__)
    parser.add_argument("folder", type=Path, help="photos and results; made if missing")
    parser.add_argument("--photos", type=int, default=400)
    parser.add_argument("--width", type=int, default=640, help="of photos, pixels")
    parser.add_argument("--blocks", type=int, default=4)
    parser.add_argument("--margin", type=float, default=BlockSettings.margin)
    parser.add_argument("--polish", type=float, default=BlockSettings.polish_iterations)
    parser.add_argument("--preset", default="standard")
    parser.add_argument("--iterations", type=int, default=0, help="0: the preset's")
    parser.add_argument("--max-gaussians", type=int, default=0, help="0: the preset's")
    parser.add_argument("--dense-start", choices=("auto", "on", "off"), default="auto")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--step", help=argparse.SUPPRESS)  # the child process of one step
    words = list(sys.argv[1:] if given is None else given)
    asked = parser.parse_args(words)
    settings = preset(asked.preset).training
    settings = dataclasses.replace(
        settings,
        iterations=asked.iterations or settings.iterations,
        max_gaussians=asked.max_gaussians or settings.max_gaussians,
        dense_start=asked.dense_start,
        preview_every_s=0.0,
    )
    blocks = BlockSettings(asked.blocks, margin=asked.margin, polish_iterations=asked.polish)
    source = make_scene(asked.folder, asked.photos, asked.width, asked.threads)
    run = Run(asked.folder, settings, blocks, asked.seed, asked.threads, source)
    if asked.step:
        run.step(asked.step)
        return 0
    steps = ["whole", "coarse", *(f"block-{k}" for k in range(blocks.blocks)), "joined"]
    for name in steps:
        if not (run.folder / name / "figures.json").is_file():
            command = [sys.executable, "-m", "benchmarks.blocks", *words, "--step", name]
            code = subprocess.run(command, check=False).returncode
            if code:
                say(f"{name} failed with exit code {code}")
                return 1
    for table in tables(run, steps):
        say(table.markdown())
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
