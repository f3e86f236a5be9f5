# SPDX-License-Identifier: GPL-3.0-or-later
"""Jobs of the open file: start, watch, cancel, resume, find; one timer polls all of them.

In: properties of the panels. Out: a worker process, its progress, and the imported result.
"""
