# SPDX-License-Identifier: GPL-3.0-or-later
"""Vacancy of points: the largest transmittance from any camera that sees them.

In: points, Gaussians, cameras, masks. Out: vacancy, the deciding camera, gradients.
"""
