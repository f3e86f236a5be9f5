# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender operators, thin: they read properties, call ``core.jobs``, import results."""
