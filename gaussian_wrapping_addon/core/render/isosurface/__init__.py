# SPDX-License-Identifier: GPL-3.0-or-later
"""Isosurface depth: where the transmittance along a ray falls to 0.5.

In: the contributors of a block of pixels. Out: depths and their slopes.
"""
