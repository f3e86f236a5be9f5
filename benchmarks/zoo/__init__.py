# SPDX-License-Identifier: GPL-3.0-or-later
"""A zoo of scenes for generalisation: nine families, each scene drawn from the seed of its name.

``python -m benchmarks.zoo`` renders them, makes runs and judges them. Settings may be tuned on the
part ``development`` only; the part ``test`` is reported.
"""
