# SPDX-License-Identifier: GPL-3.0-or-later
"""Texture baking: blend photos into texels, fill unseen texels.

In: surface points and photos. Out: texture images and their coverage.
"""
