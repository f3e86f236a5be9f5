# SPDX-License-Identifier: GPL-3.0-or-later
"""Lists of the Gaussians that reach each tile, in blending order.

In: screen Gaussians. Out: tile lists, block masks.
"""
