# SPDX-License-Identifier: GPL-3.0-or-later
"""The panel's texts in German and Japanese.

In: ``table.json``, the one table of texts. Out: Blender's translations of the add-on.
"""
