# SPDX-License-Identifier: GPL-3.0-or-later
"""Properties, panels and preferences, a module a sub-panel; no logic.

In: properties and the state of jobs, from memory. Out: what is drawn, and buttons of operators.
"""
