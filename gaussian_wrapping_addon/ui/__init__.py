# SPDX-License-Identifier: GPL-3.0-or-later
"""Properties, panels and preferences, one folder a feature; no logic."""
