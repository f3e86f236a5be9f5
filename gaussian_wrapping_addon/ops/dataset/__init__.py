# SPDX-License-Identifier: GPL-3.0-or-later
"""Choosing the photos and checking them."""
