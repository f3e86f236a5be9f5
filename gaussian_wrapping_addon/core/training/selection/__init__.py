# SPDX-License-Identifier: GPL-3.0-or-later
"""Model selection: decide from the photos which parts of the model a scene needs.

In: photos, cameras, held-out errors. Out: decisions with their evidence, shown in the report.
"""
