# SPDX-License-Identifier: GPL-3.0-or-later
"""Ground truths as their owners have them: Tanks and Temples, DTU, plain files."""
