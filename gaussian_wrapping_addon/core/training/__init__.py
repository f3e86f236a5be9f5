# SPDX-License-Identifier: GPL-3.0-or-later
"""From a scene to trained Gaussians: trainer, iteration, rounds, schedule, checkpoint.

In: a scene, photos, settings. Out: a :class:`.result.TrainingResult`. Only jobs import this.
"""
