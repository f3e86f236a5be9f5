# SPDX-License-Identifier: GPL-3.0-or-later
"""Questions answered in the worker's Python: estimate, evaluate, export, doctor."""
