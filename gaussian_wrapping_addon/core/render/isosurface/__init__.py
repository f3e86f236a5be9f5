# SPDX-License-Identifier: GPL-3.0-or-later
"""The depth at which transmittance along a ray falls to 0.5.

In: the contributors of a block of pixels. Out: depths and their slopes.
"""
