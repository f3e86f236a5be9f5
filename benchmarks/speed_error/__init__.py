# SPDX-License-Identifier: GPL-3.0-or-later
"""Parts of ``python -m benchmarks.speed_vs_error``: plan, runs, scores, tables, plots, pictures."""
