# SPDX-License-Identifier: GPL-3.0-or-later
"""Quality of the photos themselves: blur, exposure, duplicates.

In: photo files. Out: findings with what to do.
"""
