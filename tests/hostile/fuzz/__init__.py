# SPDX-License-Identifier: GPL-3.0-or-later
"""Seeded fuzzers: inputs changed at random, and what reading them ends in."""
