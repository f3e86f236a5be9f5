# SPDX-License-Identifier: GPL-3.0-or-later
"""Cost estimates of meshing, before it starts: points, faces, memory, time.

In: Gaussians, depth-map samples, a request. Out: an estimate.
"""
