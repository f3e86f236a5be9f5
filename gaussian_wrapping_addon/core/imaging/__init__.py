# SPDX-License-Identifier: GPL-3.0-or-later
"""Image metrics (PSNR, SSIM, LPIPS), resampling, image pyramids.

In: arrays of pixels. Out: metrics, gradients and samples. Independent of cameras and meshes.
"""
