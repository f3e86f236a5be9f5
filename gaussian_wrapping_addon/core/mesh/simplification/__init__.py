# SPDX-License-Identifier: GPL-3.0-or-later
"""Mesh simplification by edge collapses in order of quadric error.

In: a closed manifold. Out: one with fewer faces, or with fewer of its vertices.
"""
