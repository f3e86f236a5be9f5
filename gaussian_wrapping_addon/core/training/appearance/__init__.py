# SPDX-License-Identifier: GPL-3.0-or-later
"""What differs between photos of one scene: exposure, background.

In: renderings and photos. Out: corrected images and gradients.
"""
