# SPDX-License-Identifier: GPL-3.0-or-later
"""Unwrap, visibility, bake, gutter, mesh export."""
