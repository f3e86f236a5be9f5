# SPDX-License-Identifier: GPL-3.0-or-later
"""Starts of a training other than sparse points: an existing splat.

In: a splat. Out: Gaussians in the scene frame.
"""
