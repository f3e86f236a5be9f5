# SPDX-License-Identifier: GPL-3.0-or-later
"""Camera poses from photos alone, by pycolmap in a helper process.

In: photos. Out: a model as the readers give it.
"""
