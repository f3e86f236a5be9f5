# SPDX-License-Identifier: GPL-3.0-or-later
"""Commands of a farm in the worker's Python: scheduler, worker, certificates.

In: a request as JSON. Out: lines of text, one JSON object each, until the command is ended.
"""
