# SPDX-License-Identifier: GPL-3.0-or-later
"""The sub-panel "Train" and its properties.

In: properties of the scene, the estimate. Out: rows and buttons; ``Scene.gwrap.training``.
"""
