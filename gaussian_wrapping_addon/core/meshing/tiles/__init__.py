# SPDX-License-Identifier: GPL-3.0-or-later
"""Meshing of large regions tile by tile, with bounded memory and without seams."""
