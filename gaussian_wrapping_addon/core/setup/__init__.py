# SPDX-License-Identifier: GPL-3.0-or-later
"""Makes, repairs and removes the private environment that workers run in. Standard library only."""
