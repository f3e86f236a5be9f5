# SPDX-License-Identifier: GPL-3.0-or-later
"""Planes through the parts of photos that have no texture (docs/method.md, section 11.12).

In come the photos' depth maps and sparse points, out go depth maps whose plain parts lie on planes
that border, other photos and faint texture agree on. Scene frame throughout.
"""
