# SPDX-License-Identifier: GPL-3.0-or-later
"""Mesh clean-up: manifold repair, small handles, degenerate faces, smoothing, open boundaries.

In: a closed mesh. Out: a manifold without degenerate faces.
"""
