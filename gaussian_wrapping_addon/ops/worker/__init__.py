# SPDX-License-Identifier: GPL-3.0-or-later
"""The Python that jobs run in: preferences, check, set-up.

In: the add-on's preferences. Out: the worker's Python, what its check found, its environment.
"""
