# SPDX-License-Identifier: GPL-3.0-or-later
"""What made masks bring: held-out photos inside an object, of jobs without and with masks.

    python -m benchmarks.object_masks --judge JOB --region BOX.json [--picture FILE] BEFORE AFTER

The object in a photo is the silhouette, 2 pixels smaller, of what a third training (``--judge``, of
the same photos, without masks) has in the region. PSNR is as rendered, and with a gain and an
offset for each channel fitted inside the object. ``--picture`` writes, of the first held-out photo:
the photo, its mask, and its renderings.
"""

from __future__ import annotations

import argparse
import json
import logging
import sys
from pathlib import Path

import numpy as np
from PIL import Image
from scipy import ndimage

from gaussian_wrapping_addon.core.dataset.photos.photo_store import PhotoStore
from gaussian_wrapping_addon.core.dataset.refined_scene import load_refined_scene
from gaussian_wrapping_addon.core.dataset.view_split import held_out_views
from gaussian_wrapping_addon.core.gaussians.gaussian_file import load_gaussians
from gaussian_wrapping_addon.core.masks.cleaning import THRESHOLD
from gaussian_wrapping_addon.core.masks.silhouettes import silhouettes
from gaussian_wrapping_addon.core.regions.region import read_region
from gaussian_wrapping_addon.core.regions.scene_region import region_in_scene
from gaussian_wrapping_addon.core.render.projection.projection import RawArrays
from gaussian_wrapping_addon.core.render.types.options import RenderOptions
from gaussian_wrapping_addon.core.render.view_renderer import ViewRenderer

_logger = logging.getLogger("benchmarks.object_masks")

SIZE_PX = 480
ERODED_PX = 2
HELD_OUT_EVERY = 8


class Job:
    """Scene, Gaussians and photos of a finished training."""

    def __init__(self, folder: Path) -> None:
        self.name = folder.name
        scenes = sorted((folder / "stages").glob("masked-*/done.json"))
        scenes = scenes or sorted((folder / "stages").glob("cameras-*/done.json"))
        self.training = max(
            (folder / "stages").glob("train-*/done.json"), key=lambda path: path.stat().st_mtime
        ).parent
        self.scene = load_refined_scene(scenes[-1].parent, self.training)
        self.gaussians = load_gaussians(self.training / "gaussians.npz")
        self.photos = PhotoStore(self.scene, SIZE_PX)
        self.index = {view.camera.name: i for i, view in enumerate(self.scene.views)}

    def rendered(self, name: str) -> np.ndarray:
        """Return the photo as the Gaussians show it, (h, w, 3) in [0, 1]."""
        camera, options = self.photos.camera(self.index[name]), RenderOptions(depth=False)
        raw = RawArrays.from_gaussians(self.gaussians)
        return np.clip(ViewRenderer().render(raw, camera, options).color, 0.0, 1.0)


def objects(judge: Job, box: Path) -> dict[str, np.ndarray]:
    """Return the object's (h, w) bool mask of each held-out photo, by name."""
    region = region_in_scene(read_region(box), judge.scene.world_from_scene)
    inside = region.contains(judge.gaussians.means.double().numpy(), 0.0)
    held_out = held_out_views(judge.scene, HELD_OUT_EVERY)
    cameras = [judge.photos.camera(index) for index in held_out]
    shares = silhouettes(judge.gaussians, inside, cameras, ViewRenderer(), threads=1)
    return {
        judge.scene.views[index].camera.name: ndimage.binary_erosion(
            share >= THRESHOLD, iterations=ERODED_PX
        )
        for index, share in zip(held_out, shares, strict=True)
    }


def psnr_inside(
    rendered: np.ndarray, photo: np.ndarray, mask: np.ndarray, *, fitted: bool
) -> float:
    """Return the PSNR inside a mask, dB."""
    errors = []
    for channel in range(3):
        values, wanted = rendered[..., channel][mask], photo[..., channel][mask] / 255.0
        if fitted:
            design = np.stack([values, np.ones_like(values)], 1)
            values = design @ np.linalg.lstsq(design, wanted, rcond=None)[0]
        errors.append(np.mean((values - wanted) ** 2))
    return float(-10.0 * np.log10(np.mean(errors)))


def write_picture(path: Path, name: str, jobs: list[Job]) -> None:
    """Write photo, mask and renderings of one photo side by side."""
    last = jobs[-1]
    photo = last.photos.photo(last.index[name])
    mask = last.photos.mask(last.index[name])
    columns = [photo] if mask is None else [photo, np.where(mask[..., None], photo, photo // 4)]
    columns += [np.rint(255.0 * job.rendered(name)).astype(np.uint8) for job in jobs]
    Image.fromarray(np.concatenate(columns, 1)).save(path, quality=88)


def main(arguments: list[str]) -> int:
    """Measure, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--judge", type=Path, required=True)
    parser.add_argument("--region", type=Path, required=True)
    parser.add_argument("--picture", type=Path)
    parser.add_argument("jobs", type=Path, nargs="+")
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    masks = objects(Job(options.judge), options.region)
    jobs = [Job(folder) for folder in options.jobs]
    for job in jobs:
        figures = [
            [
                psnr_inside(job.rendered(name), job.photos.photo(job.index[name]), mask, fitted=f)
                for f in (False, True)
            ]
            for name, mask in masks.items()
            if name in job.index
        ]
        plain, fitted = np.mean(figures, 0)
        done = json.loads((job.training / "done.json").read_text())
        _logger.info(
            "%s: %d photos, %.2f dB, fitted %.2f dB, %d Gaussians, training %.0f processor s",
            job.name, len(figures), plain, fitted, len(job.gaussians), done["processor_seconds"],
        )  # fmt: skip
    if options.picture:
        write_picture(options.picture, next(iter(masks)), jobs)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
