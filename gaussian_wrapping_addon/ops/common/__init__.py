# SPDX-License-Identifier: GPL-3.0-or-later
"""Shared by the features: tags of objects, error reports, background work, known job folders."""
