# SPDX-License-Identifier: GPL-3.0-or-later
"""Camera poses from photos alone."""
