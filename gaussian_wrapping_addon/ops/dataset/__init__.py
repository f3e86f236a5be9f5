# SPDX-License-Identifier: GPL-3.0-or-later
"""Choice and check of the photos.

In: a folder or file that is chosen. Out: its path and the findings, as properties.
"""
