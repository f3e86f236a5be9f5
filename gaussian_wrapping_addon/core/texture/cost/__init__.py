# SPDX-License-Identifier: GPL-3.0-or-later
"""Size of a texture, and the memory needed to bake it."""
