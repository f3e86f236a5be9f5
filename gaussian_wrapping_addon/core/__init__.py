# SPDX-License-Identifier: GPL-3.0-or-later
"""Everything that is not Blender: photos in, textured meshes out. Never imports bpy."""
