# SPDX-License-Identifier: GPL-3.0-or-later
"""What is measured of a finished mesh, by other means than those that made it."""
