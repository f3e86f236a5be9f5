# SPDX-License-Identifier: GPL-3.0-or-later
"""Child processes and the Python that they run in: spawn, helpers, environment."""
