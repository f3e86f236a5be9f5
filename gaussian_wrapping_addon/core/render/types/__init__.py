# SPDX-License-Identifier: GPL-3.0-or-later
"""Data classes of the renderer: options, images, gradients."""
