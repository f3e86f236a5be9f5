# SPDX-License-Identifier: GPL-3.0-or-later
"""Commands of ``farm`` for Dask: certificates, scheduler, workers here and elsewhere, doctor.

In: options. Out: requests to commands in the worker's Python, which run until they are ended.
"""
