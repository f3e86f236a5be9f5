# SPDX-License-Identifier: GPL-3.0-or-later
"""Density control: densification, pruning, orientations and wrapping clones.

In: statistics of views. Out: an updated set of Gaussians with their moments.
"""
