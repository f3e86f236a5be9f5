# SPDX-License-Identifier: GPL-3.0-or-later
"""Stages that make masks for the photos of a job, and the scene with those that people left.

In: the stage of the cameras. Out: a stage like it, whose scene has the masks.
"""
