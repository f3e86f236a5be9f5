# SPDX-License-Identifier: GPL-3.0-or-later
"""Rendering of oriented Gaussians, forward and backward.

In: Gaussians and a camera. Out: images and gradients. ``render.py`` is for autograd,
``view_renderer.py`` for the trainer; ``cuda`` has the same on a GPU.
"""
