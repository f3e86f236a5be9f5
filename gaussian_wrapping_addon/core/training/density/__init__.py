# SPDX-License-Identifier: GPL-3.0-or-later
"""Which Gaussians there are: adding, pruning, orientation and clones.

In: statistics of views. Out: a changed set of Gaussians and of their moments.
"""
