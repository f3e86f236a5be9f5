# SPDX-License-Identifier: GPL-3.0-or-later
"""Initialisation of a training from an existing splat instead of sparse points.

In: a splat. Out: Gaussians in the scene frame. The start from sparse points is
``core/gaussians/initialisation.py``.
"""
