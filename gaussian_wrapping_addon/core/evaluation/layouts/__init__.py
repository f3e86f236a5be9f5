# SPDX-License-Identifier: GPL-3.0-or-later
"""Readers of ground truths in their original layouts: Tanks and Temples, DTU, plain files."""
