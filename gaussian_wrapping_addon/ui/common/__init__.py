# SPDX-License-Identifier: GPL-3.0-or-later
"""What all panels share: their base, text for narrow columns, properties of settings."""
