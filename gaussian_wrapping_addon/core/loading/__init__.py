# SPDX-License-Identifier: GPL-3.0-or-later
"""From an input path to a scene: check, views, start points."""
