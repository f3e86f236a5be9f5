# SPDX-License-Identifier: GPL-3.0-or-later
"""Triangle meshes: the data class, its file between stages, sampling, components, depth buffer.

In: vertices and faces. Out: measures and arrays. Independent of Gaussians and fields.
"""
