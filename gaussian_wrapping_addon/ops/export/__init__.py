# SPDX-License-Identifier: GPL-3.0-or-later
"""Meshes of a result as files of other programs, written by Blender."""
