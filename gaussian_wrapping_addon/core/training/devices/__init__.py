# SPDX-License-Identifier: GPL-3.0-or-later
"""What an iteration of the training computes, on the processor or on a GPU.

In: a window of a photo and the Gaussians. Out: losses, gradients, stepped Gaussians.
"""
