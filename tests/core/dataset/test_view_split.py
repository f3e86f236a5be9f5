# SPDX-License-Identifier: GPL-3.0-or-later
"""Held-out views, and the views that are trained on."""

from __future__ import annotations

import dataclasses

import numpy as np

from gaussian_wrapping_addon.core.scene.scene import evenly_spaced, held_out_views, training_views
from tests.core.training.small_scene import PhotosInMemory, sphere_scene


def test_held_out_photos_are_every_nth_of_the_sorted_names() -> None:
    scene, _ = sphere_scene(views=9, size_px=24)
    assert held_out_views(scene, 8) == [0, 8]
    assert held_out_views(scene, 4) == [0, 4, 8]
    backwards = dataclasses.replace(scene, views=scene.views[::-1])
    assert held_out_views(backwards, 3) == [2, 5, 8]
    assert held_out_views(scene, 0) == []
    few = dataclasses.replace(scene, views=scene.views[:5])
    assert held_out_views(few, 2) == [0]


def test_photos_covered_by_their_mask_are_not_trained_on() -> None:
    scene, photos = sphere_scene(views=9, size_px=24)
    assert training_views(scene, photos, 4) == [1, 2, 3, 5, 6, 7]
    assert training_views(scene, photos, 0) == list(range(9))
    masks = [np.ones((24, 24), np.bool_) for _ in range(9)]
    masks[2][:] = False
    masked = PhotosInMemory(scene, photos.photos, masks)
    assert training_views(scene, masked, 4) == [1, 3, 5, 6, 7]
    assert training_views(scene, masked, 0) == [0, 1, 3, 4, 5, 6, 7, 8]


def test_a_few_of_many_are_spread_evenly_from_the_first_to_the_last() -> None:
    assert evenly_spaced("abcdefghi", 3) == ["a", "e", "i"]
    assert evenly_spaced(range(10), 4) == [0, 3, 6, 9]
    assert evenly_spaced(range(40), 1) == [0]
    for count in range(5):
        assert evenly_spaced(range(count), 5) == list(range(count))
