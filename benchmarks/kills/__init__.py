# SPDX-License-Identifier: GPL-3.0-or-later
"""Jobs that are interrupted at random moments of every stage, resumed, and compared bit for bit.

In: how often each way of interruption is tried, and a seed. Out: one outcome a trial in
``benchmarks/records/kills``, and ``docs/benchmarks/kills.md``.
"""
