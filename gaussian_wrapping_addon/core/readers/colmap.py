# SPDX-License-Identifier: GPL-3.0-or-later
"""Find and read a COLMAP model: choose the submodel, validate images, keep usable ones."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import numpy as np

from .. import limits
from ..errors import DatasetError, ParseError
from ..photos.finder import resolve_photo
from ..progress import LEFT_OUT_HINT, ReportWarning
from ..scene.camera import rotation_from_quaternion
from . import colmap_binary, colmap_text
from .colmap_binary import RawImage, RawPoints
from .source_model import COLMAP, LensCamera, PosedPhoto, SourceModel

_LAYOUTS = ("sparse", "colmap/sparse", ".")
_EXAMPLES = 3
"""Names quoted in a warning about several images."""


@dataclass(frozen=True)
class ModelFiles:
    """The folder of one model and the suffix of its files."""

    folder: Path
    suffix: str

    def path(self, stem: str) -> Path:
        """Return the path of ``cameras``, ``images`` or ``points3D``."""
        return self.folder / f"{stem}{self.suffix}"

    @property
    def reader(self) -> ModuleType:
        """The module that reads files of this suffix."""
        return colmap_binary if self.suffix == ".bin" else colmap_text


def find_models(source: Path) -> list[ModelFiles]:
    """List the models under ``source``: in ``sparse/0..``, ``sparse`` and ``source`` itself.

    Binary files are preferred to text files of the same folder; the layouts are searched in this
    order, up to the first that holds a model.
    """
    for layout in _LAYOUTS:
        root = source / layout
        if not root.is_dir():
            continue
        numbered = [p for p in root.iterdir() if p.name.isdecimal() and p.is_dir()]
        folders = [*sorted(numbered, key=lambda p: int(p.name)), root]
        found = [m for folder in folders if (m := _model_in(folder)) is not None]
        if found:
            return found
    return []


def _model_in(folder: Path) -> ModelFiles | None:
    for suffix in (".bin", ".txt"):
        if all((folder / f"{stem}{suffix}").is_file() for stem in ("cameras", "images")):
            return ModelFiles(folder, suffix)
    return None


def read_colmap(source: Path) -> SourceModel:
    """Read the largest usable COLMAP model under ``source``.

    Raises DatasetError: there is no model, or it has no usable image; ParseError: a file is
    truncated or broken; names the byte or line.
    """
    models = find_models(source)
    if not models:
        hint = "Expected: cameras, images and points3D (.bin or .txt) in sparse/0, sparse or here."
        raise DatasetError(f"{source.name} holds no COLMAP model.", hint)
    warnings: list[ReportWarning] = []
    chosen = models[0]
    if len(models) > 1:
        chosen, counts = _largest(models, warnings)
        names = [m.folder.relative_to(source).as_posix() for m in models]
        listed = ", ".join(f"{name} ({n})" for name, n in zip(names, counts, strict=True))
        used = chosen.folder.relative_to(source).as_posix()
        text = f"The input holds {len(models)} models: {listed}; {used} was used."
        hint = "Take photos that connect the parts, so that one model holds them all."
        warnings.append(ReportWarning("several-models", text, hint))
    model = read_model(chosen)
    facts = {"model": chosen.folder.relative_to(source).as_posix() or ".", **model.facts}
    if chosen.suffix == ".bin" and (chosen.folder / "images.txt").is_file():
        facts["model_files"] = "binary (text files were also present)"
    return dataclasses.replace(model, warnings=(*warnings, *model.warnings), facts=facts)


def _largest(
    models: list[ModelFiles], warnings: list[ReportWarning]
) -> tuple[ModelFiles, list[int]]:
    """Return the model with most images; broken ones count as empty unless all are broken."""
    counts, failure = [], None
    for model in models:
        try:
            images, _ = model.reader.read_images(model.path("images"))
            counts.append(len(images))
        except ParseError as error:
            failure = failure or error
            text = f"Model {model.folder.name} was left out: {error.message}"
            warnings.append(ReportWarning("model-left-out", text, LEFT_OUT_HINT))
            counts.append(0)
    if failure is not None and max(counts) == 0:
        raise failure
    return models[int(np.argmax(counts))], counts


def read_model(model: ModelFiles) -> SourceModel:
    """Read one model; unusable images and points are left out with counted warnings.

    Raises ParseError, DatasetError.
    """
    reader = model.reader
    cameras, warnings = reader.read_cameras(model.path("cameras"))
    images, more = reader.read_images(model.path("images"))
    warnings = [*warnings, *more]
    photos = _usable_photos(model.folder, images, cameras, warnings)
    if not photos:
        text = f"None of the {len(images)} images of {model.path('images').name} is usable."
        hint = " ".join([*(warning.text for warning in warnings[-1:]), "Solve the cameras again."])
        raise DatasetError(text, hint)
    points_path = model.path("points3D")
    if points_path.is_file():
        raw, more = reader.read_points(points_path)
        warnings.extend(more)
    else:
        raw = RawPoints(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(0), np.zeros(0))
        text = f"{points_path.name} is missing; start points are made from the photos."
        hint = "Export the COLMAP model together with its points."
        warnings.append(ReportWarning("points-missing", text, hint))
    finite = np.isfinite(raw.positions).all(1)
    if not finite.all():
        text = f"{int((~finite).sum())} points that are not finite were left out."
        warnings.append(ReportWarning("points-not-finite", text, LEFT_OUT_HINT))
    facts = {
        "camera_models": sorted({p.lens.model for p in photos if p.lens is not None}),
        "images_in_model": len(images),
        "points_in_model": len(raw.positions),
    }
    measured = finite & (raw.errors >= 0) & (raw.errors <= limits.MAX_IMAGE_SIDE_PX)
    weights = raw.track_lengths * measured
    if weights.sum() > 0:
        error_px = float((np.where(measured, raw.errors, 0.0) * weights).sum() / weights.sum())
        facts["mean_reprojection_error_px"] = round(error_px, 3)
    points, colors = raw.positions[finite], raw.colors[finite]
    return SourceModel(COLMAP, tuple(photos), points, colors, tuple(warnings), facts)


def _usable_photos(
    root: Path,
    images: list[RawImage],
    cameras: dict[int, LensCamera],
    warnings: list[ReportWarning],
) -> list[PosedPhoto]:
    """Keep images with a safe name, a known camera and a finite pose; warn about the others."""
    photos: list[PosedPhoto] = []
    dropped: dict[str, list[str]] = {}
    seen_ids: set[int] = set()
    seen_names: set[str] = set()
    for image in images:
        rotation = rotation_from_quaternion(image.quaternion)
        name = image.name.replace("\\", "/")
        reason = ""
        if not is_safe_name(root, name):
            reason = "an unsafe name"
        elif image.image_id in seen_ids or name in seen_names:
            reason = "a number or name that was used before"
        elif image.camera_id not in cameras:
            reason = "a camera that is not in the model"
        elif rotation is None or not np.isfinite(image.translation).all():
            reason = "a pose that is not finite, or a zero quaternion"
        if reason or rotation is None:
            dropped.setdefault(reason, []).append(f"{image.name[:80]!r} ({image.place})")
            continue
        seen_ids.add(image.image_id)
        seen_names.add(name)
        pose = np.concatenate([rotation, image.translation[:, None]], 1)
        photos.append(PosedPhoto(name, cameras[image.camera_id], pose, observed=image.observed))
    for reason, names in dropped.items():
        listed = ", ".join(names[:_EXAMPLES]) + (" ..." if len(names) > _EXAMPLES else "")
        text = f"{len(names)} images were left out for {reason}: {listed}."
        warnings.append(ReportWarning("images-left-out", text, LEFT_OUT_HINT))
    return photos


def is_safe_name(root: Path, name: str) -> bool:
    """Tell whether a photo's name from a file stays inside ``root`` on every system."""
    try:
        return (
            name.strip() not in ("", ".")
            and len(name.encode(errors="surrogateescape")) <= limits.MAX_NAME_BYTES
            and resolve_photo(root, name) is not None
        )
    except (OSError, ValueError):
        return False
