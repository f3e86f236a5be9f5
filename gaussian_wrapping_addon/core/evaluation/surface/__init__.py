# SPDX-License-Identifier: GPL-3.0-or-later
"""How far a surface is from the true one."""
