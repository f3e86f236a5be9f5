# SPDX-License-Identifier: GPL-3.0-or-later
"""The choices of settings."""

from __future__ import annotations

PRESETS = ("draft", "standard", "fine", "paper", "large")
SELECTION_MODES = ("auto", "on", "off")
"""Of an optional part of the model; ``"auto"`` selects it by evidence in the photos."""
SWITCH = ("off", "on")

DEVICE = r"auto|cpu|cuda(:[0-9]{1,3})?"
"""Pattern of the devices that a job can be given."""

COMPUTERS = r"|local|(tcp|tls)://(\[[0-9A-Fa-f:.]{2,45}\]|[A-Za-z0-9._-]{1,253}):[0-9]{1,5}"
"""Pattern of where the parts of a job run; empty: here, in one process."""
MAX_PROCESSES = 64

MASK_MODES = ("ignore", "background", "auto")
"""``"auto"``: background where the masks were made of a turntable, a region or by a model, else
ignore."""
MASKS_MADE = ("off", "region")
MODEL_RANGES = ("imagenet", "half", "unit")
"""Colours of a segmentation model: mean and deviation of ImageNet, -0.5 to 0.5, 0 to 1."""
MAX_MASK_GROW_PX = 200
GEOREFERENCES = ("auto", "on", "off")
TURNTABLE_MODES = ("auto", "on", "off")
PANORAMA_MODES = ("auto", "on", "off")
CORRELATIONS = ("signed", "squared")
SPACINGS = ("adaptive", "uniform")
MESH_METHODS = ("pam", "pivots")
PIVOT_COUNTS = (2, 3, 9)
PIVOT_BOXES = ("normal", "gof")
PIVOT_SAMPLES = ("depth", "none")
BOUNDARIES = ("closed", "open")
UNSEEN = ("empty", "occupied")
FIELD_CAMERAS = ("training", "all")
MAX_LODS = 8
TEXTURE_SOURCES = ("photos", "gaussians")
UV_CHOICES = ("auto", "own", "new")
"""Of a mesh from elsewhere; ``"auto"``: its own if it has any."""
UP_AXES = ("auto", "y", "z")
"""Of a mesh file; ``"auto"``: as the format is exported."""
