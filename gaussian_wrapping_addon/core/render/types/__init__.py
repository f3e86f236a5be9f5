# SPDX-License-Identifier: GPL-3.0-or-later
"""What a renderer takes and gives: options, images, gradients."""
