# SPDX-License-Identifier: GPL-3.0-or-later
"""Readers of ground truths in their original layouts: Tanks and Temples, DTU, plain files.

In: folders and files as their publishers give them. Out: meshes, points, cameras; scores.
"""
