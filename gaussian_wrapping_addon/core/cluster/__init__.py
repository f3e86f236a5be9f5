# SPDX-License-Identifier: GPL-3.0-or-later
"""Child processes on a Dask cluster: of this computer, or of several.

In: commands with names. Out: how each ended. Nothing here knows what the commands do.
"""
