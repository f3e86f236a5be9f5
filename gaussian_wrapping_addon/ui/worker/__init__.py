# SPDX-License-Identifier: GPL-3.0-or-later
"""Drawing of the worker's set-up."""
