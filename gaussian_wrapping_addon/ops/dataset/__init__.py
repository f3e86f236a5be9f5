# SPDX-License-Identifier: GPL-3.0-or-later
"""Choice and check of the photos."""
