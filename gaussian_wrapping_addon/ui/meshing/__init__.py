# SPDX-License-Identifier: GPL-3.0-or-later
"""The sub-panels "Mesh" and "Texture".

In: selected regions, properties of settings. Out: rows and buttons.
"""
