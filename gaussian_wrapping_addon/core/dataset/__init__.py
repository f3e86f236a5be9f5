# SPDX-License-Identifier: GPL-3.0-or-later
"""Data sets: cameras, the scene with its views and points, and readers of inputs.

The modules here are the data classes; the folders read inputs and make a scene of them.
"""
