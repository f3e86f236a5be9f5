# SPDX-License-Identifier: GPL-3.0-or-later
"""Distances and scores between a surface and the true one.

In: meshes, clouds, cameras. Out: precision, recall, F1, Chamfer distances.
"""
