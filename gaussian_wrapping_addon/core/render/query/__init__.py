# SPDX-License-Identifier: GPL-3.0-or-later
"""Depth at any sub-pixel position, and its gradients.

In: a view and positions. Out: depths there, and gradients of Gaussians and positions.
"""
