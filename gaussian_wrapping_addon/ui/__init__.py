# SPDX-License-Identifier: GPL-3.0-or-later
"""Properties, panels and preferences; no logic."""
