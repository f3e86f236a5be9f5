# SPDX-License-Identifier: GPL-3.0-or-later
"""The commands of ``batch.py``: what each of them does, and how a job is shown.

In: arguments. Out: lines for the terminal and an exit code.
"""
