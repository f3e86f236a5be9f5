# SPDX-License-Identifier: GPL-3.0-or-later
"""Estimating a training and continuing a finished one."""
