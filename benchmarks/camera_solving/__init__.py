# SPDX-License-Identifier: GPL-3.0-or-later
"""Cameras of photos alone, judged by exact cameras, GPS and the matches of all pairs.

In: real photo sets, and photos of a town and of a repeating hall made here. Out: records, and the
page docs/benchmarks/camera-solving.md.
"""
