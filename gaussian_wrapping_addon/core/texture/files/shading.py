# SPDX-License-Identifier: GPL-3.0-or-later
"""Roughness and specular level of lit materials, the same in Blender and in every file format."""

ROUGHNESS = 0.9
"""Photos contain their lighting: added gloss would look wrong from most directions."""

SPECULAR_LEVEL = 0.1
"""Blender's scale: 0.5 is a reflectance of 4 %, which corresponds to glTF's factor 1."""

OBJ_SHININESS = 1000.0 * (1.0 - ROUGHNESS) ** 2
"""``Ns`` of OBJ as Blender maps it to roughness; other programs use it as Phong exponent."""
