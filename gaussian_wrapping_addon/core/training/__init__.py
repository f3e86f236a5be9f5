# SPDX-License-Identifier: GPL-3.0-or-later
"""Losses, density control, wrapping rounds, schedule, trainer, checkpoints."""
