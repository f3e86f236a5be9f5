# SPDX-License-Identifier: GPL-3.0-or-later
"""A video of a walk around an object: frames chosen, cameras and mesh judged against photos."""
