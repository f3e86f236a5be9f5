# SPDX-License-Identifier: GPL-3.0-or-later
"""Masks made for photos: of what stands in a region, or by a segmentation model.

In: a trained scene and convex regions, or a model's file. Out: one black and white image a photo,
which people may look at, edit and reject.
"""
