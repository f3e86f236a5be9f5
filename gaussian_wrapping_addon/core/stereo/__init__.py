# SPDX-License-Identifier: GPL-3.0-or-later
"""Multi-view PatchMatch stereo on the processor: where surfaces are before training starts.

In come photos with cameras and sparse points, out go depths, normals and confidences per photo, and
points fused from them (docs/method.md, section 11). Scene frame throughout.
"""
