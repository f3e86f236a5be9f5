# SPDX-License-Identifier: GPL-3.0-or-later
"""A queue of many small wraps on a cluster of this computer, struck twice by SIGKILL.

In: how many wraps, and a seed. Out: ``benchmarks/records/farm_queue`` and
``docs/benchmarks/queue.md``.
"""
