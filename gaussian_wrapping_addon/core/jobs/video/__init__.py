# SPDX-License-Identifier: GPL-3.0-or-later
"""The stage that takes photos out of a video, run by the stage of the cameras.

In: a job whose input is a video. Out: a folder of photos, and what is known of them.
"""
