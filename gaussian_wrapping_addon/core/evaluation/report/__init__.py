# SPDX-License-Identifier: GPL-3.0-or-later
"""The report of a job, for people and programs.

In: figures of all stages. Out: ``report.json``, ``report.md``, pictures.
"""
