# SPDX-License-Identifier: GPL-3.0-or-later
"""How the lit material of a result shines: the same in Blender and in every file."""

ROUGHNESS = 0.9
"""Photos carry their own light: a glossy guess on top of it would look wrong from most sides."""

SPECULAR_LEVEL = 0.1
"""As Blender counts: 0.5 is a reflectance of 4 %, which glTF's factor 1 stands for."""

OBJ_SHININESS = 1000.0 * (1.0 - ROUGHNESS) ** 2
"""``Ns`` of OBJ as Blender writes and reads roughness; others take it for Phong's exponent."""
