# SPDX-License-Identifier: GPL-3.0-or-later
"""Meshes rendered from the cameras of photos."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..compiled import kernel
from ..errors import UsageError
from ..filters import Pyramid, pyramid, trilinear
from ..image_metrics import (
    PSNR_CAP_DB,
    Lpips,
    ViewScores,
    corrected_for_measuring,
    has_windows,
    lpips_ready,
    psnr,
    score_images,
)
from ..mesh.depth_buffer import depth_buffer
from ..mesh.textured_mesh import TexturedMesh
from ..parallel import default_threads, even_bounds, run_chunks
from ..scene.camera import Camera

# -- Render a textured mesh from a camera: unlit, antialiased, on a plain grey background ---------


BACKGROUND = (92, 92, 94)
SUPERSAMPLING = 3
"""Rays per pixel along each axis."""


@dataclass(frozen=True)
class TexturedView:
    """A rendering and its coverage."""

    image: np.ndarray
    """(h, w, 3) uint8; :data:`BACKGROUND` outside the mesh, blended along silhouettes."""
    coverage: np.ndarray  # (h, w) float32 in [0, 1]: share of the pixel's rays that meet the mesh

    @property
    def covered(self) -> np.ndarray:
        """(h, w) bool: every ray of the pixel meets the mesh."""
        return self.coverage == 1.0

    def on_black(self) -> np.ndarray:
        """Return (h, w, 3) float32, white 1: the same picture on a black background."""
        behind = (1.0 - self.coverage)[..., None] * np.array(BACKGROUND, np.float32)
        return (np.maximum(self.image - behind, 0.0) / 255.0).astype(np.float32)


class TexturedRenderer:
    """Render one textured mesh of the scene frame from many cameras; faces are two-sided.

    Surfaces nearer than ``depth_buffer.NEAR_DEPTH`` are clipped. 0 threads use every core; the
    result does not depend on their number.
    """

    def __init__(self, textured: TexturedMesh, *, threads: int = 0) -> None:
        self._threads = threads or default_threads()
        self._vertices = np.ascontiguousarray(textured.mesh.vertices, np.float64)
        self._faces = np.ascontiguousarray(textured.mesh.faces, np.int32)
        self._uvs = np.ascontiguousarray(textured.corner_uvs, np.float64)
        self._textures = [pyramid(atlas.albedo) for atlas in textured.atlases]
        self._atlas = textured.atlas_of_faces

    def render(self, camera: Camera, size: tuple[int, int] | None = None) -> TexturedView:
        """Render from a camera of the scene frame, whose view is resampled.

        ``size`` is the width and height of the picture in pixels, by default that of the camera.
        """
        width, height = size or (camera.width, camera.height)
        fine = camera.resized(width * SUPERSAMPLING, height * SUPERSAMPLING)
        hit = depth_buffer(self._vertices, self._faces, fine, threads=self._threads).face
        local = fine.to_camera(self._vertices)
        intrinsics = np.array([fine.fx, fine.fy, fine.cx, fine.cy])
        image = np.empty((fine.height, fine.width, 3), np.uint8)
        image[:] = BACKGROUND

        for number, texture in enumerate(self._textures):
            shown = hit
            if len(self._textures) > 1:
                mine = self._atlas[hit.clip(0)] == number
                shown = np.where(mine, hit, hit.dtype.type(-1))

            def band(
                begin: int, end: int, shown: np.ndarray = shown, texture: Pyramid = texture
            ) -> None:
                _shade(
                    shown, begin, end, local, self._faces, self._uvs, intrinsics,
                    texture.pixels, texture.levels, image,
                )  # fmt: skip

            run_chunks(band, even_bounds(fine.height, self._threads), self._threads)
        rays = SUPERSAMPLING**2
        return TexturedView(
            ((_pixel_sums(image) + rays // 2) // rays).astype(np.uint8),
            _pixel_sums(hit >= 0).astype(np.float32) / np.float32(rays),
        )


def _pixel_sums(rays: np.ndarray) -> np.ndarray:
    """Sum over the rays of each pixel: (3 h, 3 w, ...) bool or uint8 to (h, w, ...) uint16."""
    total = rays[::SUPERSAMPLING, ::SUPERSAMPLING].astype(np.uint16)
    for row, column in list(np.ndindex(SUPERSAMPLING, SUPERSAMPLING))[1:]:
        total += rays[row::SUPERSAMPLING, column::SUPERSAMPLING]
    return total


@kernel(fast=False)
def _shade(
    hit: Any, begin: int, end: int, local: Any, faces: Any, uvs: Any, intrinsics: Any, pixels: Any,
    levels: Any, image: Any,
) -> None:  # fmt: skip
    side_x, side_y = float(levels[0, 1]), float(levels[0, 2])
    normal = np.empty(3)
    for row in range(begin, end):
        for column in range(hit.shape[1]):
            face = hit[row, column]
            if face < 0:
                continue
            a, b, c = local[faces[face, 0]], local[faces[face, 1]], local[faces[face, 2]]
            e0, e1, e2 = b[0] - a[0], b[1] - a[1], b[2] - a[2]
            g0, g1, g2 = c[0] - a[0], c[1] - a[1], c[2] - a[2]
            normal[0] = e1 * g2 - e2 * g1
            normal[1] = e2 * g0 - e0 * g2
            normal[2] = e0 * g1 - e1 * g0
            double_area2 = normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2
            dx = (column + 0.5 - intrinsics[2]) / intrinsics[0]
            dy = (row + 0.5 - intrinsics[3]) / intrinsics[1]
            slope = normal[0] * dx + normal[1] * dy + normal[2]
            if double_area2 <= 0.0 or slope == 0.0:
                continue
            z = (normal[0] * a[0] + normal[1] * a[1] + normal[2] * a[2]) / slope
            p0, p1, p2 = z * dx - a[0], z * dy - a[1], z - a[2]
            # Barycentric weights from areas of the sub-triangles, signed along the normal.
            wc = (
                normal[0] * (e1 * p2 - e2 * p1)
                + normal[1] * (e2 * p0 - e0 * p2)
                + normal[2] * (e0 * p1 - e1 * p0)
            ) / double_area2
            wb = (
                normal[0] * (p1 * g2 - p2 * g1)
                + normal[1] * (p2 * g0 - p0 * g2)
                + normal[2] * (p0 * g1 - p1 * g0)
            ) / double_area2
            wb = min(max(wb, 0.0), 1.0)
            wc = min(max(wc, 0.0), 1.0 - wb)
            wa = 1.0 - wb - wc
            uv = uvs[face]
            u = (wa * uv[0, 0] + wb * uv[1, 0] + wc * uv[2, 0]) * side_x
            v = (1.0 - (wa * uv[0, 1] + wb * uv[1, 1] + wc * uv[2, 1])) * side_y
            # Texels of this face in one pixel: ratio of its areas in the texture and in space.
            uv_area = abs(
                (uv[1, 0] - uv[0, 0]) * (uv[2, 1] - uv[0, 1])
                - (uv[2, 0] - uv[0, 0]) * (uv[1, 1] - uv[0, 1])
            )
            texels = uv_area * side_x * side_y / np.sqrt(double_area2)
            footprint = (z / intrinsics[0]) ** 2
            level = 0.5 * np.log2(max(texels * footprint, 1.0))
            red, green, blue = trilinear(pixels, levels, level, u, v)
            image[row, column, 0] = int(red + 0.5)
            image[row, column, 1] = int(green + 0.5)
            image[row, column, 2] = int(blue + 0.5)


# -- Mesh-based rendering: compare renderings of the textured mesh with photos --------------------
#
# Unlike :mod:`.mesh_based_rendering`, no colour field is trained on the mesh: the mesh is
# evaluated with its final texture (docs/method.md, section 9.3).


OnView = Callable[[str, np.ndarray, np.ndarray], None]


@dataclass(frozen=True)
class MeshView:
    """Figures of one photo."""

    name: str  # name of the camera
    scores: ViewScores
    covered: float
    """Share of the candidate pixels (of the mask, or of the whole photo without one) that the mesh
    covers wholly."""
    uncovered: float  # share of the candidate pixels in which no ray meets a face
    whole_psnr: float  # PSNR over all candidate pixels, black where no face covers them, dB
    exposed_psnr: float | None = None
    """PSNR, dB, of the rendering brought to the photo's exposure
    (:func:`~.image_metrics.corrected_for_measuring`), as held-out photos are measured where
    exposures are modelled; ``None`` where it was not asked for."""

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values; ``lpips`` and ``exposed_psnr`` only if measured."""
        exposed = {} if self.exposed_psnr is None else {"exposed_psnr": self.exposed_psnr}
        return {
            "name": self.name, **self.scores.to_json(), "covered": self.covered,
            "uncovered": self.uncovered, "whole_psnr": self.whole_psnr, **exposed,
        }  # fmt: skip


@dataclass(frozen=True)
class MeshRenderingScore:
    """Figures of all photos; means are over photos with equal weights."""

    views: tuple[MeshView, ...]
    pixels: str
    """``"mask"``: pixels of the given masks; ``"covered"``: pixels that the mesh covers wholly."""
    left_out: int
    """Photos without a valid pixel, or without one on which an SSIM window can be centred."""
    lpips_note: str = ""  # why LPIPS is missing

    def mean(self, name: str) -> float | None:
        """Return the mean over the views that have the figure: a key of their JSON values."""
        found = [values[name] for view in self.views if name in (values := view.to_json())]
        return sum(found) / len(found) if found else None

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values; unmeasured values are absent, and no value is infinite."""
        names = ("psnr", "ssim", "lpips", "covered", "uncovered", "whole_psnr", "exposed_psnr")
        means = {name: self.mean(name) for name in names}
        values: dict[str, Any] = {
            "views": [view.to_json() for view in self.views],
            **{name: value for name, value in means.items() if value is not None},
            "pixels": self.pixels,
            "left_out": self.left_out,
        }
        if self.lpips_note:
            values["lpips_note"] = self.lpips_note
        return values


def render_views(
    textured: TexturedMesh, cameras: Sequence[Camera], images: Sequence[np.ndarray], *,
    masks: Sequence[np.ndarray] | None = None, counted: Sequence[np.ndarray | None] | None = None,
    lpips: Lpips | None = None, threads: int = 0, on_view: OnView | None = None,
    exposed: bool = False,
) -> MeshRenderingScore:  # fmt: skip
    """Render the mesh from each camera and compare with its photo.

    PSNR, SSIM and LPIPS are those of :func:`~.image_metrics.score_images` over the valid
    pixels. The rendering is unlit, two-sided and antialiased with ``SUPERSAMPLING`` squared rays
    per pixel.

    Parameters
    ----------
    cameras : sequence of Camera
        In the mesh's frame (see ``Camera.moved``), each of the size of its photo.
    images : sequence of (h, w, 3) uint8, or floats whose white is 1
        The photos.
    masks : sequence of (h, w) bool, optional
        Valid pixels, such as true silhouettes. Pixels that the mesh leaves uncovered have the
        background colour and are compared too: a hole is an error. Without masks, the pixels that
        the mesh covers wholly are compared: holes and missing parts cost nothing, and occluders in
        front of the mesh in the photo are errors.
    counted : sequence of ((h, w) bool or None), optional
        Candidate pixels of each photo, such as the photo's own mask.
    threads : int
        0 uses every core; the result does not depend on it, except for the last digits of LPIPS.
    on_view : callable, optional
        Called with name, photo and rendering of each view compared.
    exposed : bool
        Measure PSNR in the photos' exposures as well, whose own the texture does not have.

    Raises
    ------
    UsageError
        A photo or mask differs in size from its camera, or their numbers differ.
    """
    threads = threads or default_threads()
    renderer = TexturedRenderer(textured, threads=threads)
    views: list[MeshView] = []
    left_out = 0
    for camera, photo, mask, may_count in zip(
        cameras,
        _one_each(images, cameras, "photos"),
        _one_each(masks, cameras, "masks"),
        _one_each(counted, cameras, "masks"),
        strict=True,
    ):
        check_sizes(camera, photo, mask, may_count)
        view = renderer.render(camera)
        candidates = np.ones(view.covered.shape, np.bool_)
        for part in (mask, may_count):
            if part is not None:
                candidates &= part
        judged = candidates & view.covered if mask is None else candidates
        if not has_windows(judged.shape, judged):
            left_out += 1
            continue
        scores = score_images(view.image, photo, judged, lpips=lpips, threads=threads)
        count = np.count_nonzero(candidates)
        covered = np.count_nonzero(view.covered & candidates) / count
        uncovered = np.count_nonzero((view.coverage == 0.0) & candidates) / count
        whole = min(psnr(view.on_black(), photo, candidates), PSNR_CAP_DB)
        of_photo = None
        if exposed:
            corrected = corrected_for_measuring(view.image / np.float32(255), photo, judged)
            of_photo = min(psnr(corrected, photo, judged), PSNR_CAP_DB)
        views.append(MeshView(camera.name, scores, covered, uncovered, whole, of_photo))
        if on_view is not None:
            on_view(camera.name, photo, view.image)
    pixels = "covered" if masks is None else "mask"
    return MeshRenderingScore(tuple(views), pixels, left_out, _note(lpips, views))


def _one_each(given: Sequence[Any] | None, cameras: Sequence[Camera], what: str) -> Sequence[Any]:
    if given is None:
        return [None] * len(cameras)
    if len(given) != len(cameras):
        raise UsageError(
            f"{len(given)} {what} for {len(cameras)} cameras.", f"Give {what}, one for each camera."
        )
    return given


def check_sizes(camera: Camera, *pictures: np.ndarray | None) -> None:
    """Raise ``UsageError`` if a picture differs in size from its camera."""
    for picture in pictures:
        if picture is not None and picture.shape[:2] != (camera.height, camera.width):
            raise UsageError(
                f"{camera.name}: a picture of {picture.shape[:2]} pixels (height, width) for a "
                f"camera of {(camera.height, camera.width)}.",
                "Resize the camera or the picture.",
            )


def _note(lpips: Lpips | None, views: list[MeshView]) -> str:
    if lpips is None:
        ready, reason = lpips_ready()
        return "LPIPS was not requested." if ready else reason
    if views and all(view.scores.lpips is None for view in views):
        return "The pictures are too small for LPIPS."
    return ""
