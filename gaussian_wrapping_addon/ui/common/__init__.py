# SPDX-License-Identifier: GPL-3.0-or-later
"""Shared by the panels: base class, text for narrow columns, properties of settings.

In: declarations of the settings, texts. Out: properties, rows of panels, wrapped lines.
"""
