# SPDX-License-Identifier: GPL-3.0-or-later
"""A job as parts: planned, walked in their order, each run here or by a process of an engine.

In: a job folder with its job file. Out: ``parts.json``, a state of each part, finished stages.
"""
