# SPDX-License-Identifier: GPL-3.0-or-later
"""Drawing of the masks' buttons and review, inside the panel Region."""
