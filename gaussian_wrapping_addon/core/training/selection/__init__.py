# SPDX-License-Identifier: GPL-3.0-or-later
"""Model selection: how much of the model a scene needs, each decision with its evidence.

In: photos, cameras, held-out errors. Out: decisions that the report shows.
"""
