# SPDX-License-Identifier: GPL-3.0-or-later
"""Cameras and points from files of COLMAP, transforms.json and other programs."""
