# SPDX-License-Identifier: GPL-3.0-or-later
"""Drawing of the worker's set-up.

In: the state of the worker's environment. Out: rows and buttons of the preferences and the panel.
"""
