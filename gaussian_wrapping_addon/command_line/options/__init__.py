# SPDX-License-Identifier: GPL-3.0-or-later
"""Options of the command line, generated from the declarations of the settings.

In: a parser, or its parsed options. Out: options, or settings.
"""
