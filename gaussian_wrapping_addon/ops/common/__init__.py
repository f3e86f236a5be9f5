# SPDX-License-Identifier: GPL-3.0-or-later
"""Shared by the features: tags of objects, error reports, background work, known job folders.

In: objects, tasks, exceptions of operators. Out: tags, results on the main thread, messages.
"""
