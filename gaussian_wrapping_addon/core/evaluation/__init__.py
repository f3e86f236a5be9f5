# SPDX-License-Identifier: GPL-3.0-or-later
"""Evaluation of results: against a ground truth, against photos, and the report of a job.

In: meshes, ground truths, photos. Out: scores, pictures, reports. ``command.py`` evaluates one mesh
against one ground truth.
"""
