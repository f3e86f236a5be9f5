# SPDX-License-Identifier: GPL-3.0-or-later
"""Data of a scene: cameras, views, frame, placement."""
