# SPDX-License-Identifier: GPL-3.0-or-later
"""Estimating and selecting the regions that are to be meshed."""
