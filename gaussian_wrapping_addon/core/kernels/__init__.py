# SPDX-License-Identifier: GPL-3.0-or-later
"""Support for numba kernels: decorators, on-disk cache, threads, reused memory.

In: functions to compile and ranges to run. Out: kernels that release the GIL and are loaded
from disk in the next process.
"""
