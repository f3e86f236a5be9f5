# SPDX-License-Identifier: GPL-3.0-or-later
"""Parts of ``python -m benchmarks.training``: plan, pivots, tables, acceptance, plots, document."""
