# SPDX-License-Identifier: GPL-3.0-or-later
"""Losses and their gradients on images and on pairs of views.

In: a rendered view, photos, neighbouring views. Out: values and gradients.
"""
