# SPDX-License-Identifier: GPL-3.0-or-later
"""Colours of texels: here photos become texels, and what no photo shows is filled.

In: points of the surface and photos. Out: images and what they cover.
"""
