# SPDX-License-Identifier: GPL-3.0-or-later
"""Child processes: where the worker's Python is, how children start, what they may use.

In: a module's name and its arguments. Out: a process with a deadline and a memory limit, or a
typed error.
"""
