# SPDX-License-Identifier: GPL-3.0-or-later
"""The words that settings are chosen from."""

from __future__ import annotations

PRESETS = ("draft", "standard", "fine")
SELECTION_MODES = ("auto", "on", "off")
"""Of a part of the model: ``"auto"`` selects it where the photos give evidence for it."""
SWITCH = ("off", "on")

MASK_MODES = ("ignore", "background")
CORRELATIONS = ("signed", "squared")
SPACINGS = ("adaptive", "uniform")
MESH_METHODS = ("pam", "pivots")
PIVOT_COUNTS = (2, 3, 9)
BOUNDARIES = ("closed", "open")
UNSEEN = ("empty", "occupied")
MAX_LODS = 8
TEXTURE_SOURCES = ("photos", "gaussians")
