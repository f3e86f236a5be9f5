# SPDX-License-Identifier: GPL-3.0-or-later
"""The panel "Scene Tools".

In: the current result. Out: rows and buttons.
"""
