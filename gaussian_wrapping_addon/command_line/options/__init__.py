# SPDX-License-Identifier: GPL-3.0-or-later
"""Options of the command line, made from the declarations of the settings.

In: a parser, or what it has parsed. Out: options, or settings.
"""
