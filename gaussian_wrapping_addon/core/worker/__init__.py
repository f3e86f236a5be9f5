# SPDX-License-Identifier: GPL-3.0-or-later
"""Child processes and the Python that they run in.

In: a module's name and a request. Out: its result, or a typed error; nothing outlives its caller.
"""
