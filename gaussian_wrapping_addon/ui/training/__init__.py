# SPDX-License-Identifier: GPL-3.0-or-later
"""The sub-panel "Train" and its properties."""
