# SPDX-License-Identifier: GPL-3.0-or-later
"""Estimates and the list of regions to be meshed."""
