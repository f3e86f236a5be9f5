# SPDX-License-Identifier: GPL-3.0-or-later
"""Quadric edge collapse: one engine and two policies.

Quadrics, queue, link condition and merging are common to both. ``half_edge_collapse`` keeps
vertices in place (which vertices of a dense mesh a coarser one keeps); ``optimal_collapse`` moves
them to where the error is least (decimation). In: points and faces. Out: fewer faces.
"""
