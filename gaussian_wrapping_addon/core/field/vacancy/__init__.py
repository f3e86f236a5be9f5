# SPDX-License-Identifier: GPL-3.0-or-later
"""Vacancy field: the largest transmittance to a point from any camera that sees it.

In: points, Gaussians, cameras, masks. Out: vacancy, the arg-max camera, gradients.
"""
