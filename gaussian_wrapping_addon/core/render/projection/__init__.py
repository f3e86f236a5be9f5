# SPDX-License-Identifier: GPL-3.0-or-later
"""Projection of Gaussians to screen Gaussians, and its analytic gradient.

In: Gaussians and a camera. Out: ``params (n, 24)``, boxes, depths (docs/architecture.md).
"""
