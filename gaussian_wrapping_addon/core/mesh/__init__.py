# SPDX-License-Identifier: GPL-3.0-or-later
"""Triangle meshes by themselves: topology and simplification, without Gaussians or cameras."""
