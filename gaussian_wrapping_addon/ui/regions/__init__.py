# SPDX-License-Identifier: GPL-3.0-or-later
"""The panel "Region", and how regions are drawn and dragged in the 3D view."""
