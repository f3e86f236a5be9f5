# SPDX-License-Identifier: GPL-3.0-or-later
"""Photos and videos: found, read, kept in memory."""
