# SPDX-License-Identifier: GPL-3.0-or-later
"""Triangle meshes: the data class, its file between stages, sampling, components, depth buffer.

In: vertices and faces. Out: figures and arrays about them. Knows neither Gaussians nor fields.
"""
