# SPDX-License-Identifier: GPL-3.0-or-later
"""Statistics and validation of finished meshes, independent of the code that made them."""
