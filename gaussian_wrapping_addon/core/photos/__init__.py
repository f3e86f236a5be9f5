# SPDX-License-Identifier: GPL-3.0-or-later
"""Photos and videos: found, decoded, kept in memory as far as they fit.

In: folders and files that one does not trust. Out: arrays, facts of headers, sharp frames.
"""
