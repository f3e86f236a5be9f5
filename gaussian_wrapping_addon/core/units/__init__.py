# SPDX-License-Identifier: GPL-3.0-or-later
"""Metres and places: GPS, control points, markers."""
