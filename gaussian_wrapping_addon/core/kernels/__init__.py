# SPDX-License-Identifier: GPL-3.0-or-later
"""Compiled code: numba decorators, the cache on disk, threads, and memory that is reused.

In: functions to compile and ranges to run. Out: kernels that release the GIL and are loaded
from disk in the next process.
"""
