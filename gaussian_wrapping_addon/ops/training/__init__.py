# SPDX-License-Identifier: GPL-3.0-or-later
"""Estimate of a training, and continuation of a finished one."""
