# SPDX-License-Identifier: GPL-3.0-or-later
"""Known textures, photos of them, and how well a bake brings them back."""
