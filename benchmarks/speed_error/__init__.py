# SPDX-License-Identifier: GPL-3.0-or-later
"""Parts of ``python -m benchmarks.speed_vs_error``: cases, scores, tables, plot, document.

``plan``, ``runs``, ``score`` and ``tables`` serve other benchmarks as well.
"""
