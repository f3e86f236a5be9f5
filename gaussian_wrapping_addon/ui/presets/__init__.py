# SPDX-License-Identifier: GPL-3.0-or-later
"""The menu of the user's presets.

In: names of the files. Out: rows of a menu.
"""
