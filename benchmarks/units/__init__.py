# SPDX-License-Identifier: GPL-3.0-or-later
"""Metres: scale from printed markers on rendered photos, cameras against GPS of drone photos."""
