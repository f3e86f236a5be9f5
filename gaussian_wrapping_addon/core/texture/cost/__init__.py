# SPDX-License-Identifier: GPL-3.0-or-later
"""How large a texture should be, and what baking it takes of memory."""
