# SPDX-License-Identifier: GPL-3.0-or-later
"""Scene tools: scale, ground, up and origin of a result, by its parent empty alone.

In: picked points, distances, the result's cameras. Out: the parent's transform, ``placement.json``.
"""
