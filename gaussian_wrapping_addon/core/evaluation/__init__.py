# SPDX-License-Identifier: GPL-3.0-or-later
"""How good a result is: against a ground truth, against photos, and the job's report.

``command.py`` judges one mesh against one truth.
"""
