# SPDX-License-Identifier: GPL-3.0-or-later
"""Train oriented Gaussians from a scene: trainer, iteration, rounds, schedule, checkpoints.

In: a scene, photos, settings. Out: a :class:`.state.TrainingResult`. Only jobs import this.
"""
