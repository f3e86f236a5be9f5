# SPDX-License-Identifier: GPL-3.0-or-later
"""Gaussians to rows of screen Gaussians, and the analytic gradient back.

In: Gaussians and a camera. Out: ``params (n, 24)``, boxes, depths (docs/architecture.md).
"""
