# SPDX-License-Identifier: GPL-3.0-or-later
"""The renderer on NVIDIA GPUs: CUDA C compiled at run time, driven through the driver's C API.

In: Gaussians as CUDA tensors and a camera. Out: the same images and gradients as on the CPU.
"""
