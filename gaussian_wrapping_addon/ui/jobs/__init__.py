# SPDX-License-Identifier: GPL-3.0-or-later
"""Drawing of a job: progress, outcome, next step, live figures and picture.

In: the last known state of the scene's job. Out: rows of the panel that started it.
"""
