# SPDX-License-Identifier: GPL-3.0-or-later
"""Measurements of single parts of the meshing."""
