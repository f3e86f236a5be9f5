# SPDX-License-Identifier: GPL-3.0-or-later
"""From closed triangle sets to clean manifolds: repair, small handles, smoothing, boundaries.

In: a closed mesh. Out: a manifold without faces of no area.
"""
