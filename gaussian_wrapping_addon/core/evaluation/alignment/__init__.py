# SPDX-License-Identifier: GPL-3.0-or-later
"""Similarity transforms that bring a result into the frame of its truth, and pose errors.

In: points or camera centres of both. Out: similarity transforms, errors of positions and rotations.
"""
