# SPDX-License-Identifier: GPL-3.0-or-later
"""What a mesh will take before it is made: points, faces, memory, time."""
