# SPDX-License-Identifier: GPL-3.0-or-later
"""Photo cameras as Blender cameras, and looking through them."""
