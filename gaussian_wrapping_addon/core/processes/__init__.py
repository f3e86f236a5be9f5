# SPDX-License-Identifier: GPL-3.0-or-later
"""Child processes: how they are started and ended.

In: argument lists. Out: processes in groups of their own.
"""
