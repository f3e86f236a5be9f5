# SPDX-License-Identifier: GPL-3.0-or-later
"""Parts of ``python -m benchmarks.meshing``: plan, meshes, judging, targets, tables, plots."""
