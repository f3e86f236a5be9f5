# SPDX-License-Identifier: GPL-3.0-or-later
"""The sub-panel "Computers": where jobs run, and how far their parts are.

In: ``Scene.gwrap.computers``, parts as last read. Out: rows and buttons.
"""
