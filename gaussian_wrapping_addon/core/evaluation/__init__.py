# SPDX-License-Identifier: GPL-3.0-or-later
"""Evaluation of results: against a ground truth, against photos, and the report of a job.

``command.py`` evaluates one mesh against one ground truth.
"""
