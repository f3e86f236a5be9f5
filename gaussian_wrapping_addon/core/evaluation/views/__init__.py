# SPDX-License-Identifier: GPL-3.0-or-later
"""Renderings of the textured mesh, compared with photos.

In: a textured mesh, cameras, photos. Out: pictures and figures.
"""
