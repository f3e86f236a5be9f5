# SPDX-License-Identifier: GPL-3.0-or-later
"""What was photographed: cameras, photos, masks, sparse points, frames."""
