# SPDX-License-Identifier: GPL-3.0-or-later
"""A job from request to result: runner, worker process, and the client that starts it.

In: a job file. Out: a result folder. The folders hold its files, its stages and its commands.
"""
