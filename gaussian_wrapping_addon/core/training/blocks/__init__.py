# SPDX-License-Identifier: GPL-3.0-or-later
"""Training in blocks: parts of a scene, each trained by itself around the same coarse training.

In: a scene, photos, settings. Out: a plan, the Gaussians of each block, and their joined training.
"""
