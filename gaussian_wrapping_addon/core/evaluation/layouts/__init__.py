# SPDX-License-Identifier: GPL-3.0-or-later
"""Readers of what a mesh is compared with."""
