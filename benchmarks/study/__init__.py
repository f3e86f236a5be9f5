# SPDX-License-Identifier: GPL-3.0-or-later
"""Studies of many runs over several sittings: cases, records of single runs, statistics.

A record (``benchmarks/records/STUDY/*.json``) is committed: documents are written from records
alone, and a run that has one is not made again.
"""
