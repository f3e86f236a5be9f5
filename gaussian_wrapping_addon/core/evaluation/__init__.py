# SPDX-License-Identifier: GPL-3.0-or-later
"""View metrics, previews, the report."""
