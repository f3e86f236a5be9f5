# SPDX-License-Identifier: GPL-3.0-or-later
"""How far a picture is from its photo, and the pictures themselves."""
