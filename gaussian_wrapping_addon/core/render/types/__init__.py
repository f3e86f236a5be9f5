# SPDX-License-Identifier: GPL-3.0-or-later
"""Data classes of the renderer: options, images, gradients.

In: options of a rendering. Out: images of a view, gradients of images and of visible Gaussians.
"""
