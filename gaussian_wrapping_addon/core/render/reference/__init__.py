# SPDX-License-Identifier: GPL-3.0-or-later
"""The definition of the renderer in plain torch: what every kernel must equal."""
