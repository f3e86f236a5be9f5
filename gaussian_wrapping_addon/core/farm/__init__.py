# SPDX-License-Identifier: GPL-3.0-or-later
"""Several computers: children on a Dask cluster, addresses, certificates, SSH, SLURM and PBS.

In: requests. Out: how each ended and where. ``child.py`` is sent to the other side as source.
"""
