# SPDX-License-Identifier: GPL-3.0-or-later
"""Depth and transmittance at any sub-pixel position, and their gradients.

In: a view and positions. Out: values there, and gradients of Gaussians and positions.
"""
