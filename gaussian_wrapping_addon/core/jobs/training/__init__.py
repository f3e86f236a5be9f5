# SPDX-License-Identifier: GPL-3.0-or-later
"""Training as a part of jobs: in one piece, or in blocks that are trained by themselves.

In: the job folder and the stage of the cameras. Out: the finished stage of the training.
"""
