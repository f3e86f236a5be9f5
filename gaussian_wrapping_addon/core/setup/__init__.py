# SPDX-License-Identifier: GPL-3.0-or-later
"""Makes and removes the worker's private environment. Standard library only.

In: a Python and the pinned requirements. Out: an environment that jobs can run in.
"""
