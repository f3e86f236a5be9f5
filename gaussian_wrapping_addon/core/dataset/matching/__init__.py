# SPDX-License-Identifier: GPL-3.0-or-later
"""Features of photos, and which pairs to match: by order, GPS, resemblance, and known poses.

In: photos and their places. Out: pairs, and a database with verified matches.
"""
