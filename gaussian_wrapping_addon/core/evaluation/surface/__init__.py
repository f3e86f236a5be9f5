# SPDX-License-Identifier: GPL-3.0-or-later
"""Distances and scores of a reconstructed surface against the ground truth.

In: meshes, point clouds, cameras. Out: precision, recall, F1, Chamfer distances.
"""
