# SPDX-License-Identifier: GPL-3.0-or-later
"""Camera poses refined during training: in come gradients of the Gaussians, out go cameras."""
