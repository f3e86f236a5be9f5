# SPDX-License-Identifier: GPL-3.0-or-later
"""Per-photo appearance: exposure and background.

In: renderings and photos. Out: corrected images and gradients.
"""
