# SPDX-License-Identifier: GPL-3.0-or-later
"""Metres: from GPS of photos, printed markers of known size, or control points in a file.

In: posed pinhole cameras, positions and pixels. Out: similarities to metric frames, with residuals.
"""
