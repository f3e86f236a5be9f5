# SPDX-License-Identifier: GPL-3.0-or-later
"""Job file, job folder, stages, runner, worker entry, client."""
