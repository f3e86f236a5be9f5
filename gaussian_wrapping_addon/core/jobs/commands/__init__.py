# SPDX-License-Identifier: GPL-3.0-or-later
"""Commands that run in the worker's Python: estimate, evaluate, export, work on tiles, doctor.

In: a request of the command line or the panel. Out: lines for the terminal, values, files; errors.
Each writes one JSON object per line to stdout, in the protocol of :mod:`.run_in_worker`.
"""
