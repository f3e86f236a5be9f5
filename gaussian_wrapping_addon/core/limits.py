# SPDX-License-Identifier: GPL-3.0-or-later
"""Limits of input, and tolerances of geometry, each with its reason."""

from __future__ import annotations

# -- Limits on input files and on resources -------------------------------------------------------


MAX_IMAGES = 100_000
MAX_SOURCE_FILES = 1_000_000
"""Files of any kind below the folder of the photos."""
MAX_POINTS = 50_000_000
MAX_GAUSSIANS = 20_000_000
MAX_IMAGE_PIXELS = 100_000_000
MAX_IMAGE_SIDE_PX = 50_000
MAX_VIDEO_S = 3600.0
"""Longest video: an hour; reading it takes about as long."""
MAX_VIDEO_FRAMES = 250_000  # more than an hour at 60 frames a second
MAX_CHOSEN_FRAMES = 2000
MAX_JSON_BYTES = 64 * 1024 * 1024
MAX_STATUS_BYTES = 1024 * 1024
"""Largest status or lock file: Blender's main thread reads them."""
MAX_PART_STATE_BYTES = 64 * 1024
MAX_JSON_DEPTH = 32
MAX_LINE_BYTES = 1024 * 1024
MAX_NAME_BYTES = 1024
MAX_REGION_VERTICES = 10_000
MAX_MODEL_BYTES = 2 * 1024**3
"""Largest segmentation model: that of one ONNX file."""
MAX_MESH_POINTS = 5_000_000
MAX_TILES = 4096
MAX_BLOCKS = 1024
"""Of a training: a plan keeps a flag for each Gaussian and block."""
MAX_PARTS = 50_000  # of a job: those of a few regions of the most tiles
MAX_PARTS_BYTES = 32 * 1024 * 1024
MAX_TEXTURE_SIDE_PX = 8192
MAX_ATLASES = 16
"""Largest number of textures per mesh: each is a material and an image for readers."""
MAX_AUTOMATIC_ATLASES = 4
"""Largest automatic number of textures per mesh, used if one of maximum size is not enough."""
MIN_IMAGES = 3
MAX_UNREADABLE_SHARE = 0.2
"""Of an input's photos: with more that cannot be read, the input is refused, not thinned out."""
MIN_PHOTO_SIDE_PX = 16
"""Smallest side of a photo or a frame of a video that is used."""
RENDER_BUDGET_BYTES = 512 * 1024 * 1024
"""Memory for lists and gradients of tile intersections in one rendering: with it, a million
Gaussians train at 1600 x 1200 pixels within 4 GB."""
PHOTO_MEMORY_SHARE = 0.25
"""Of the free memory, for decoded photos: Gaussians, images and depth maps need the rest."""
MIN_PHOTO_MEMORY_BYTES = 256 * 1024 * 1024
MAX_PHOTO_MEMORY_BYTES = 8 * 1024**3
UNKNOWN_PHOTO_MEMORY_BYTES = 1024**3
"""Where the system does not tell how much memory is free."""
DECODED_PHOTOS_DISK_SHARE = 0.5
"""Of the free disk, for decoded photos that do not fit into memory: checkpoints need little."""

SHORTEST_EDGE = 1e-30
"""Of a mesh, in world units. Shorter lengths could become 0 in other units: automatic."""

HELPER_DEADLINE_S = 3600.0
PARTIAL_FILE_S = 60.0
"""Time after the last write to a temporary file until it counts as left by a killed process."""
SILENT_S = 90.0
"""Time without a heartbeat after which a process of another computer counts as ended. File systems
of networks may show a heartbeat a minute late."""
CANCEL_ALONE_S = 7.0
"""Time after which a cancelled worker exits if its main thread does not poll for cancellation."""
CANCEL_GRACE_S = 9.0
"""Time after which other processes end a cancelled worker; including termination, within 12 s."""


# -- Numerical tolerances and constants of the method ---------------------------------------------
#
# Lengths are in scene units unless a name says otherwise (camera centres' mean at 0, radius
# :data:`SCENE_RADIUS`).


SCENE_RADIUS = 5.0
"""Scenes are scaled so that 1.1 x the largest distance of a camera from their mean equals this."""

FAR_RADIUS = 10.0 * SCENE_RADIUS  # from here on a Gaussian may stand for the sky
POINT_REACH = 1e4 * SCENE_RADIUS
"""Sparse points farther than this from the centre of the cameras are not used.

From there the cameras' largest baseline of two radii is 2e-4 rad, less than a pixel of a photo
5000 pixels wide: no photo tells the depth, and such points are errors of the reconstruction, which
reach 1e6 radii. Nearer ones are well within what kernels can compute (:data:`FINITE_Z_MAX`), and
float32 rounds their place by 1e-7 rad."""

NEAR_Z = 0.04 * SCENE_RADIUS
"""Gaussians whose centre is nearer than this (z-depth) are not rendered.

See docs/method.md, section 1.7.
"""

ALPHA_MIN = 1.0 / 255.0
ALPHA_MAX = 0.99
TRANSMITTANCE_MIN = 1e-4
"""Blending constants (docs/method.md, section 2.2)."""

ISO_LEVEL = 0.5
DEPTH_VALID_TRANSMITTANCE = 0.45
"""A pixel has an isosurface depth only where the final transmittance is at most this."""

SLOPE_FLOOR = 1e-3
"""Floor of -d(log T)/dt in the depth's gradient, relative to 1/sigma along the ray of the Gaussian
at which the blending crosses 0.5 (docs/method.md, section 2.5)."""

TILE_PX = 16

QUATERNION_MIN_NORM = 1e-12
DIRECTION_MIN_NORM = 1e-12
ORIENTED_MIN_NORM = 0.05
"""Normals shorter than this are treated as not oriented (docs/method.md, section 5.2)."""

# Limits of a row of screen parameters (docs/architecture.md, "Screen Gaussians"): a Gaussian
# outside them is not visible, in the definition and in every kernel. Within them no product that
# rendering computes overflows float32 (3.4e38).
FINITE_OFFSET_PX = 2.0**24
"""Largest offset of a pixel from the projected mean: float32 resolves single pixels up to here."""
FINITE_NUM = 1e21
FINITE_DEN = 1e16
"""Largest ``num`` and ``den`` in the image, as sums of absolute terms. ``num`` over the
smallest ``den`` is 1e37. Gaussians of 1e-4 at a distance of 1e5 reach 1e18, discs of 1e6 : 1
reach 1e13."""
FINITE_SPREAD = 1e16
"""Largest ``a0 sigma_z^2``. Its inverse is the smallest ``den`` of any ray, so that kernels may
clamp ``den`` to :data:`DENOMINATOR_MIN`. A disc of 1e8 : 1 reaches it."""
DENOMINATOR_MIN = 1.0 / FINITE_SPREAD
FINITE_PULL = 1e18
"""Largest z-depth times sharpness (1 / sigma^2) of any ray: the depth solver squares it."""
FINITE_Z_MIN, FINITE_Z_MAX = 1e-9, 1e12
"""Range of z-depths. The larger, over the smallest ``den`` and times the largest ``1 + p.d``
(1e8, the root of the largest ``den``), is 1e36; gradients contain 1 / z."""
FINITE_SIGMA_Z = 1e15  # largest sigma_z: its inverse square, the smallest a0, is a normal float32
FINITE_COLOR = 2.0**24  # beyond, a float32 sum no longer resolves white added to it

# Multi-view terms (docs/method.md, section 3.4).
HALF_PATCH = 3  # a patch has ``2 * 3 + 1`` samples per side ...
PATCH_STEP_PX = 0.5  # ... half a pixel of the reference apart, where that is not flat.
MAX_NOISE_PX = 1.0  # points with a larger reprojection error are occluded or wrong in one view
MIN_NOISE_PX = 1e-9  # below this, the direction of the reprojection error is rounding: no gradient
SPREAD_PRODUCT = 1e-8
"""Added to the product of the sums of squared deviations of two patches: patches of weak contrast
correlate less."""
MAX_PATCH_ERROR = 0.9  # patches with a larger error show different things
MIN_PLANE_NORMAL = 0.3  # shortest blended normal that defines a plane
MIN_PLANE_FACING = 0.1
"""Smallest cosine between normal and ray (84 degrees): more grazing planes have no patch."""
PATCH_SKIPPED, PATCH_KEPT, PATCH_BROKEN = 0, 1, 2
"""States of a pixel: not compared, compared, with values that are not finite."""
