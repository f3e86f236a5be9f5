# SPDX-License-Identifier: GPL-3.0-or-later
"""Limits on input files and on resources."""

from __future__ import annotations

MAX_IMAGES = 100_000
MAX_SOURCE_FILES = 1_000_000
"""Files of any kind below the folder of the photos."""
MAX_POINTS = 50_000_000
MAX_GAUSSIANS = 20_000_000
MAX_IMAGE_PIXELS = 100_000_000
MAX_IMAGE_SIDE_PX = 50_000
MAX_VIDEO_S = 3600.0
"""Longest video: an hour; reading it takes about as long."""
MAX_VIDEO_FRAMES = 250_000
"""More than an hour at 60 frames a second."""
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
MAX_PARTS = 50_000
"""Of a job: those of a few regions of the most tiles."""
MAX_PARTS_BYTES = 32 * 1024 * 1024
MAX_TEXTURE_SIDE_PX = 8192
MAX_ATLASES = 16
"""Largest number of textures per mesh: each is a material and an image for readers."""
MAX_AUTOMATIC_ATLASES = 4
"""Largest automatic number of textures per mesh, used if one of maximum size is not enough."""
MIN_IMAGES = 3
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
