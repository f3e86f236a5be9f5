# SPDX-License-Identifier: GPL-3.0-or-later
"""Images: PSNR, SSIM and LPIPS between two of them, resampling, image pyramids.

In: arrays of pixels. Out: figures, gradients and samples. Knows no camera and no mesh.
"""
