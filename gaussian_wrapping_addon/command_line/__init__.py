# SPDX-License-Identifier: GPL-3.0-or-later
"""The commands of ``batch.py``: their options, and what each of them does."""
