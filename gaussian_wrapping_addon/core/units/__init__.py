# SPDX-License-Identifier: GPL-3.0-or-later
"""Metres and places: GPS of photos, control points, printed markers.

In: photos and cameras. Out: a similarity from the scene to the world, with its error.
"""
