# SPDX-License-Identifier: GPL-3.0-or-later
"""Large regions, meshed tile by tile: memory stays bounded and the mesh has no seam."""
