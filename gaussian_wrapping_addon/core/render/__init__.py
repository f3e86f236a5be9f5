# SPDX-License-Identifier: GPL-3.0-or-later
"""Gaussians and a camera in, images and gradients out.

``render.py`` is for autograd, ``view_renderer.py`` for the trainer; the folders hold the steps.
"""
