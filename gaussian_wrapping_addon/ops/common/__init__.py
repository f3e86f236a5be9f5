# SPDX-License-Identifier: GPL-3.0-or-later
"""What several features share: tags of objects, reports, background work, known job folders."""
