# SPDX-License-Identifier: GPL-3.0-or-later
"""The report of a job: ``report.json`` for programs, ``report.md`` for people.

In: the figures of all stages. Out: both files and their pictures.
"""
