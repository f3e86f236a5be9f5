# SPDX-License-Identifier: GPL-3.0-or-later
"""Helper process: masks of photos by a segmentation model, one file each; runs foreign code."""

from __future__ import annotations

from pathlib import Path

from ..files import read_json, write_bytes
from ..photos.photo_file import read_photo
from ..worker.helper_process import emit
from .segmentation import SegmentationModel, cleaned, encoded


def main(folder: Path) -> None:
    """Make ``masks/000000.png``, ... of the photos in ``task.json``; those there already are kept.

    Raises WorkerError, DatasetError, ResourceError: the model cannot be used, or a photo cannot be
    read.
    """
    task = read_json(folder / "task.json")
    model = SegmentationModel(Path(task["model"]), task["range"], threads=task["threads"])
    photos = task["photos"]
    for index, photo in enumerate(photos):
        target = folder / f"{index:06d}.png"
        if not target.is_file():
            color = read_photo(Path(photo), upright=False).color
            mask = cleaned(model.share(color), (color.shape[1], color.shape[0]))
            write_bytes(target, encoded(mask))
        emit(fraction=(index + 1) / len(photos), message=f"masking photo {index + 1}")
