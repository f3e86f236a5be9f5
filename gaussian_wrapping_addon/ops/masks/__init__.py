# SPDX-License-Identifier: GPL-3.0-or-later
"""Masks of photos: made of a region, looked at, accepted and rejected.

In: region objects, the masks of a job folder. Out: a running job; decisions in that folder.
"""
