# SPDX-License-Identifier: GPL-3.0-or-later
"""What a training will take: time, memory and disk.

In: a scene, settings, the machine's speed. Out: an estimate.
"""
