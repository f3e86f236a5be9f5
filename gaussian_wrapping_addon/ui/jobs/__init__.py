# SPDX-License-Identifier: GPL-3.0-or-later
"""Drawing of a job: progress, outcome, next step, live figures and picture."""
