# SPDX-License-Identifier: GPL-3.0-or-later
"""Similarity transforms that bring a result into the frame of its truth."""
