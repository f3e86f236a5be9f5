# SPDX-License-Identifier: GPL-3.0-or-later
"""360 degree photos: in which pinhole views they are cut, and the cutting.

In: equirectangular photos, with poses or without. Out: photos of the views and their cameras.
"""
