# SPDX-License-Identifier: GPL-3.0-or-later
"""Estimate of a training, and continuation of a finished one.

In: properties of the panels. Out: time and memory, ready to draw; a job that goes on.
"""
