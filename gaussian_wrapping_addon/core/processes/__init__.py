# SPDX-License-Identifier: GPL-3.0-or-later
"""Child processes: locate the worker's Python, start processes, limit and measure memory.

In: a module's name and its arguments. Out: a process with a deadline and a memory limit, or a
typed error.
"""
