# SPDX-License-Identifier: GPL-3.0-or-later
"""Parts of meshing, each timed and compared with its definition alone."""
