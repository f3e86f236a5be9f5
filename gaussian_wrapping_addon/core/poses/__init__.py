# SPDX-License-Identifier: GPL-3.0-or-later
"""Camera poses from photos alone: pairs, features, solving with pycolmap, checks, turntables.

In: photos. Out: a source model and findings. Native code runs in helper processes.
"""
