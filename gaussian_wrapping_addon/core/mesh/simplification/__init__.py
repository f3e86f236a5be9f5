# SPDX-License-Identifier: GPL-3.0-or-later
"""Fewer faces by edge collapses in the order of their quadric error.

In: a closed manifold. Out: one of fewer faces, or the vertices that it should keep.
"""
