# SPDX-License-Identifier: GPL-3.0-or-later
"""Jobs: the client that starts one, the worker process that runs it, its runner, queues.

In: a job file. Out: a result folder. ``store`` holds the files of a job, ``stages`` its stages,
``parts`` how it is divided, ``commands`` the commands that run in the worker's Python.
"""
