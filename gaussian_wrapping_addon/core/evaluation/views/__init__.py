# SPDX-License-Identifier: GPL-3.0-or-later
"""The textured mesh seen from cameras, beside photos.

In: a textured mesh, cameras, photos. Out: pictures and figures.
"""
