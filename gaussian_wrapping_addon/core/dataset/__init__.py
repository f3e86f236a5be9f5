# SPDX-License-Identifier: GPL-3.0-or-later
"""What was photographed: cameras, the scene that holds them, its file.

The plain files here are the data classes; the folders read inputs and make a scene of them.
"""
