# SPDX-License-Identifier: GPL-3.0-or-later
"""Parts of ``python -m benchmarks.ablation``: plan, tables, plot, document."""
