# SPDX-License-Identifier: GPL-3.0-or-later
"""Detail of a dense mesh on a lighter one: normal map, ambient occlusion, levels of detail."""
