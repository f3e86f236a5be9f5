# SPDX-License-Identifier: GPL-3.0-or-later
"""Vacancy, vector and normal field, projection of points onto the isosurface."""
