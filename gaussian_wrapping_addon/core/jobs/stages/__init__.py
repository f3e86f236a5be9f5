# SPDX-License-Identifier: GPL-3.0-or-later
"""What each stage of a job does.

In: the folder of a stage and the results of earlier ones. Out: files in that folder.
"""
