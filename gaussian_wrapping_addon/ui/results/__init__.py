# SPDX-License-Identifier: GPL-3.0-or-later
"""The sub-panels "Result" and "Report".

In: the current result and its stored figures. Out: rows and buttons.
"""
