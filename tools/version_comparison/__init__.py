# SPDX-License-Identifier: GPL-3.0-or-later
"""Parts of ``tools/compare_versions.py``; nothing here imports the add-on."""
