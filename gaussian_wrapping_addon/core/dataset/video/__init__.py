# SPDX-License-Identifier: GPL-3.0-or-later
"""Photos out of a video: which frames are sharp, and how many of them the motion asks for.

In: a video file and the wanted number of frames. Out: JPEG files in order, and what was left out.
"""
