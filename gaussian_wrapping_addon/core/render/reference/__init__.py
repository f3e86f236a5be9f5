# SPDX-License-Identifier: GPL-3.0-or-later
"""Reference renderer in plain torch: the definition that every kernel is tested against.

In: Gaussians and a camera. Out: the same images, differentiable by autograd.
"""
