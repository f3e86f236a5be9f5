# SPDX-License-Identifier: GPL-3.0-or-later
"""Which face owns each texel of an atlas, and where texels lie on the mesh."""
