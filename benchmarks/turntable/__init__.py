# SPDX-License-Identifier: GPL-3.0-or-later
"""An object on a turntable before a static background: photos in, judged meshes out."""
