# SPDX-License-Identifier: GPL-3.0-or-later
"""Losses on images and on pairs of views, with their gradients.

In: a rendered view, photos, neighbouring views. Out: values and gradients.
"""
