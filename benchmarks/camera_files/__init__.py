# SPDX-License-Identifier: GPL-3.0-or-later
"""Camera files of other programs, written from known cameras; a picture of what is read back."""
