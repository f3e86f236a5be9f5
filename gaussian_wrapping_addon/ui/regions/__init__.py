# SPDX-License-Identifier: GPL-3.0-or-later
"""The panel "Region", and how regions are drawn and dragged in the 3D view.

In: region objects and their properties. Out: rows and buttons, lines and a gizmo in the 3D view.
"""
