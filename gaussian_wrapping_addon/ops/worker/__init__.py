# SPDX-License-Identifier: GPL-3.0-or-later
"""The Python that jobs run in: preferences, check, set-up."""
