# SPDX-License-Identifier: GPL-3.0-or-later
"""Copies of materials for an export, with images beside the file under names of their own."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any, cast

import bpy
import numpy as np

from ...core.errors import ResourceError, UsageError
from ..results.materials import (
    fold_specular,
    set_occlusion,
    set_shading,
    shading_of,
    show_as_emission,
)

_UNSAFE = re.compile(r"[^\w.-]+")


class MaterialCopies:
    """Copies of the materials of one exported mesh; :meth:`remove` takes them out again.

    Parameters
    ----------
    stem : str
        Name of the exported file without its suffix; prefix of the image names.
    folder : Path
        Where images are written to.
    unlit : str
        What becomes of our unlit materials: ``"keep"`` (glTF has them), ``"emission"`` or
        ``"lit"``, for formats without unlit materials, which would drop the texture.
    fold_specular : bool
        Whether the format describes reflectance by the index of refraction alone.
    """

    def __init__(self, stem: str, folder: Path, *, unlit: str, fold_specular: bool = False) -> None:
        self._stem, self._folder, self._unlit = stem, folder, unlit
        self._fold_specular = fold_specular
        self._images: dict[str, bpy.types.Image] = {}
        self._materials: list[tuple[bpy.types.Material, bpy.types.Material]] = []
        self.textures: list[str] = []
        """Names of the images written."""
        self.has_normal_map = False
        """Whether one of them is looked at."""
        self.shading: str | None = None
        """``"lit"``, ``"unlit"`` or ``"emission"``, of the last of our materials as exported."""

    def copy_of(self, material: bpy.types.Material) -> bpy.types.Material:
        """Return a copy whose images lie beside the exported file.

        Raises
        ------
        UsageError
            An image is missing, or of a kind that cannot be written as one file.
        """
        copy = material.copy()
        self._materials.append((material, copy))
        lend_name(material, copy)
        shading = shading_of(copy)
        if shading is not None:
            self.shading = shading.lower()
            if shading == "UNLIT" and self._unlit == "lit":
                set_shading(copy, "LIT")
                self.shading = "lit"
            elif shading == "UNLIT" and self._unlit == "emission":
                show_as_emission(copy)
                self.shading = "emission"
            if self._unlit != "keep" or self.shading == "unlit":
                set_occlusion(copy, None)  # no other format, nor an unlit material, has it
            if self._fold_specular:
                fold_specular(copy)
        tree: Any = copy.node_tree
        for node in tree.nodes if tree is not None else ():
            if node.bl_idname == "ShaderNodeNormalMap" and self.shading != "unlit":
                self.has_normal_map = True
            if node.bl_idname == "ShaderNodeTexImage" and node.image is not None:
                node.image = self._image(node.image)
        return copy

    def remove(self) -> None:
        """Remove all copies from the .blend data."""
        for material, copy in reversed(self._materials):
            name = copy.name
            bpy.data.materials.remove(copy)
            if material.library is None:
                material.name = name
        for image in self._images.values():
            bpy.data.images.remove(image)
        self._materials, self._images = [], {}

    def _image(self, image: bpy.types.Image) -> bpy.types.Image:
        known = self._images.get(image.name)
        if known is not None:
            return known
        plain = Path(_UNSAFE.sub("_", image.name)).stem.split(".")[0].strip("_") or "image"
        name, count = f"{self._stem}-{plain}", 1
        while f"{name}.png" in self.textures or f"{name}.jpg" in self.textures:
            count += 1
            name = f"{self._stem}-{plain}-{count}"
        path = self._folder / f"{name}{_suffix(image)}"
        _write_image(image, path)
        copy = bpy.data.images.load(str(path), check_existing=False)
        copy.name = name
        copy.colorspace_settings.name = image.colorspace_settings.name
        self._images[image.name] = copy
        self.textures.append(path.name)
        return copy


def lend_name(original: bpy.types.ID, copy: bpy.types.ID) -> str:
    """Give the copy the name of the original, so that the file has it; return the name.

    After removing the copy, the caller restores the original's name.
    """
    name = original.name
    if original.library is None:  # others cannot be renamed, and do not stand in the way
        original.name = f"exported {name}"
    copy.name = name
    return name


def _suffix(image: bpy.types.Image) -> str:
    return ".jpg" if _is_file(image) and image.file_format == "JPEG" else ".png"


def _is_file(image: bpy.types.Image) -> bool:
    return image.source == "FILE" and not image.is_dirty


def _write_image(image: bpy.types.Image, path: Path) -> None:
    """Write the image's own bytes if it is a file of this format, else Blender's pixels."""
    if image.source not in ("FILE", "GENERATED"):
        raise UsageError(f"Image {image.name} is not a single image.", "Use a single image file.")
    source = Path(bpy.path.abspath(image.filepath, library=image.library))
    if _is_file(image) and image.packed_file is None and not source.is_file():
        raise UsageError(
            f"The texture {source} does not exist.", "Restore it, or import the result again."
        )
    if not image.has_data and not _loads(image):
        raise UsageError(
            f"The texture {source} cannot be read.", "Restore it, or import the result again."
        )
    try:
        if not _is_file(image) or image.file_format not in ("PNG", "JPEG"):
            _save_as_png(image, path)
        elif image.packed_file is not None:
            path.write_bytes(cast(bytes, image.packed_file.data))
        elif source.resolve() != path.resolve():
            shutil.copyfile(source, path)
    except (OSError, RuntimeError) as error:
        raise ResourceError(
            f"{path} cannot be written: {error}.", "Choose another folder."
        ) from None


def _loads(image: bpy.types.Image) -> bool:
    """Return whether the image has pixels; Blender reads files on first access."""
    pixels: Any = image.pixels
    return bool(image.size[0] * image.size[1] and len(pixels) and image.has_data)


def _save_as_png(image: bpy.types.Image, path: Path) -> None:
    copy = image.copy()
    try:
        copy.file_format = "PNG"
        copy.save(filepath=str(path))
    finally:
        bpy.data.images.remove(copy)


def pixels_of(image: bpy.types.Image) -> np.ndarray:
    """Return (h, w, 3) uint8 of an sRGB image, the first row on top.

    Raises
    ------
    UsageError
        The image cannot be read.
    """
    width, height = image.size
    if width * height == 0:
        raise UsageError(
            f"The texture {image.filepath} cannot be read.",
            "Restore it, or import the result again.",
        )
    values = np.empty(width * height * image.channels, np.float32)
    pixels: Any = image.pixels
    pixels.foreach_get(values)
    grid = values.reshape(height, width, image.channels)[::-1]
    colors = grid[..., :3] if image.channels >= 3 else np.repeat(grid[..., :1], 3, axis=2)
    return np.rint(255.0 * np.nan_to_num(colors).clip(0.0, 1.0)).astype(np.uint8)
