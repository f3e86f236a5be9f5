# SPDX-License-Identifier: GPL-3.0-or-later
"""Adam over the Gaussians' tensors, only for the rows that a view has seen.

In: gradients. Out: parameters changed in place.
"""
