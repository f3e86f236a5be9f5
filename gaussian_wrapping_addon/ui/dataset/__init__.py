# SPDX-License-Identifier: GPL-3.0-or-later
"""The sub-panel "Dataset".

In: the chosen input and the findings of its check. Out: rows and buttons.
"""
