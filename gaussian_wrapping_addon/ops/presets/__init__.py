# SPDX-License-Identifier: GPL-3.0-or-later
"""The user's presets: settings of the panels saved under a name, applied again, deleted.

In: properties of the panels. Out: JSON files in the user's folder of presets.
"""
