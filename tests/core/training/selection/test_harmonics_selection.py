# SPDX-License-Identifier: GPL-3.0-or-later
"""Selection of the SH degree: view-dependent colours against other differences of photos."""

from __future__ import annotations

import dataclasses
import functools
import math

import numpy as np
import pytest
import torch

from gaussian_wrapping_addon.core.errors import UsageError
from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.render.projection import RawArrays
from gaussian_wrapping_addon.core.render.types import RenderOptions
from gaussian_wrapping_addon.core.render.view_renderer import ViewRenderer
from gaussian_wrapping_addon.core.scene.camera import Camera
from gaussian_wrapping_addon.core.training.harmonics_selection import (
    NEEDED_SHARE,
    HarmonicsEvidence,
    TrialView,
    _halves,
    match_exposure,
    select_harmonics,
)
from tests.core.training.small_scene import ring_cameras, sphere_gaussians

VIEWS, SIZE_PX = 40, 40


def shown(gaussians: OrientedGaussians, camera: Camera) -> np.ndarray:
    options = RenderOptions(depth=False, threads=1)
    image = ViewRenderer().render(RawArrays.from_gaussians(gaussians), camera, options)
    return image.color.copy()


@functools.lru_cache(maxsize=4)
def glossy(degree: int) -> OrientedGaussians:
    """A sphere whose points have random harmonics of one degree beside their own colour."""
    matte = sphere_gaussians()
    random = np.random.default_rng(5)
    sh = np.zeros((len(matte), (degree + 1) ** 2, 3), np.float32)
    sh[:, :1] = matte.sh.numpy()
    sh[:, degree**2 :] = 0.25 * random.normal(size=(2 * degree + 1, 3))
    return matte.replaced(sh=torch.from_numpy(sh))


def split(views: list[TrialView]) -> tuple[list[TrialView], list[TrialView]]:
    held_out = views[::6]
    return [v for v in views if not any(v is h for h in held_out)], held_out


def photographed(truth: OrientedGaussians) -> list[TrialView]:
    return [TrialView(c, shown(truth, c)) for c in ring_cameras(VIEWS, SIZE_PX)]


def untrained(gaussians: OrientedGaussians) -> OrientedGaussians:
    """Degree 0 alone, a little wrong in colour and place, as after a short training."""
    random = np.random.default_rng(7)
    sh = gaussians.sh[:, :1] + torch.from_numpy(
        0.15 * random.normal(size=(len(gaussians), 1, 3)).astype(np.float32)
    )
    shift = 0.01 * random.normal(size=(len(gaussians), 3)).astype(np.float32)
    return gaussians.replaced(sh=sh, means=gaussians.means + torch.from_numpy(shift))


def altered(views: list[TrialView], known: bool) -> list[TrialView]:
    """The photos under an exposure that changes around the object, as a moving sun would."""
    out = []
    for view in views:
        toward = view.camera.center / np.linalg.norm(view.camera.center)
        gain = 1.0 + 0.15 * toward[0] + np.array([0.0, 0.05, -0.05]) * toward[1]
        offset = np.full(3, 0.03 * toward[1])
        photo = (gain * view.photo + offset).astype(np.float32)
        correction = (gain, offset) if known else None
        out.append(dataclasses.replace(view, photo=photo, correction=correction))
    return out


def test_a_glossy_scene_asks_for_its_degree_and_a_matte_one_does_not() -> None:
    gloss = select_harmonics(untrained(glossy(1)), *split(photographed(glossy(1))), 1, threads=1)
    matte = select_harmonics(
        untrained(sphere_gaussians()), *split(photographed(sphere_gaussians())), 1, threads=1
    )
    assert gloss.needed
    assert gloss.share > 0.8
    assert gloss.gain_db > 1.0
    assert not matte.needed
    assert matte.share < 0.01
    assert matte.coefficients is None
    assert gloss.evaluated == matte.evaluated == VIEWS
    assert gloss.well_seen > 0.8


def test_the_coefficients_lower_the_error_of_a_held_out_photo() -> None:
    start = untrained(glossy(1))
    train, held_out = split(photographed(glossy(1)))
    evidence = select_harmonics(start, train, held_out, 1, threads=1)
    assert evidence.coefficients is not None
    assert evidence.coefficients.shape == (len(start), 4, 3)
    better = start.replaced(sh=torch.from_numpy(evidence.coefficients))
    for view in held_out:
        before = np.mean((shown(start, view.camera) - view.photo) ** 2)
        assert np.mean((shown(better, view.camera) - view.photo) ** 2) < 0.8 * before


def test_held_out_photos_judge_and_are_never_fitted_to() -> None:
    start = untrained(glossy(1))
    train, held_out = split(photographed(glossy(1)))
    darker = [dataclasses.replace(v, photo=0.8 * v.photo) for v in held_out]
    honest, spoiled = (select_harmonics(start, train, h, 1, threads=1) for h in (held_out, darker))
    without = select_harmonics(start, train, [], 1, threads=1)
    assert honest.evaluated == VIEWS
    assert without.evaluated == len(train)
    assert without.needed
    assert spoiled.gain_db < honest.gain_db
    assert honest.coefficients is not None
    assert spoiled.coefficients is not None
    assert np.array_equal(honest.coefficients, spoiled.coefficients)


def test_wrong_places_are_not_taken_for_gloss_and_do_not_hide_it() -> None:
    random = np.random.default_rng(3)
    matte = sphere_gaussians(600)
    shift = 0.01 * torch.from_numpy(random.normal(size=(600, 3)).astype(np.float32))
    sh = torch.cat([matte.sh, glossy(1).sh[:1, 1:].expand(600, 3, 3)], dim=1)
    shares = []
    for truth in (matte, matte.replaced(sh=sh)):
        start = untrained(matte)
        bent = start.replaced(means=start.means + shift)
        evidence = select_harmonics(bent, *split(photographed(truth)), 1, threads=1)
        assert evidence.evaluated == VIEWS
        shares.append(evidence.share)
    assert shares[0] < 0.5 * NEEDED_SHARE
    assert shares[1] > 0.5


def test_gloss_of_a_part_is_measured_as_a_part() -> None:
    matte, shiny = sphere_gaussians(), glossy(1)
    shares = []
    for height in (0.7, 0.5, -2.0):  # 0.15, 0.25 and all of the surface
        sh = shiny.sh.clone()
        sh[shiny.means[:, 2] < height, 1:] = 0.0
        views = photographed(shiny.replaced(sh=sh))
        shares.append(select_harmonics(untrained(matte), *split(views), 1, threads=1).share)
    # Slow errors reach a little beyond the part.
    assert 0.1 < shares[0] < 0.3 < shares[1] < 0.5 < 0.9 < shares[2]


def test_halves_part_neighbours_and_alternating_captures() -> None:
    views = photographed(sphere_gaussians())
    one, two = _halves(views)
    assert len(one) == len(two) == VIEWS // 2
    for half in (one, two):
        positions = [next(i for i, v in enumerate(views) if v is h) for h in half]
        for period in (2, 3, 4):
            of_kind = np.bincount(np.array(positions) % period, minlength=period)
            assert of_kind.min() >= VIEWS // (5 * period)


def test_what_a_lower_degree_explains_does_not_count_for_a_higher_one() -> None:
    start = untrained(glossy(1))
    evidence = select_harmonics(start, *split(photographed(glossy(1))), 2, threads=1)
    assert not evidence.needed


def test_known_exposures_are_not_taken_for_gloss() -> None:
    truth = sphere_gaussians()
    start, views = untrained(truth), photographed(truth)
    unknown = select_harmonics(start, *split(altered(views, known=False)), 1, threads=1)
    assert unknown.needed  # the photos' differences do look like gloss
    train, held_out = split(altered(views, known=True))
    blind = [dataclasses.replace(view, correction=None) for view in held_out]
    for judges in (held_out, blind):
        assert not select_harmonics(start, train, judges, 1, threads=1).needed


def test_masked_pixels_count_nowhere() -> None:
    start = untrained(sphere_gaussians())
    random = np.random.default_rng(1)
    clean, spoiled = [], []
    for view in photographed(sphere_gaussians()):
        mask = np.ones((SIZE_PX, SIZE_PX), bool)
        mask[:, : SIZE_PX // 2] = False
        photo = view.photo.copy()
        photo[~mask] = random.random(size=photo[~mask].shape)
        clean.append(dataclasses.replace(view, mask=mask))
        spoiled.append(dataclasses.replace(view, photo=photo, mask=mask))
    first = select_harmonics(start, *split(clean), 1, threads=1)
    second = select_harmonics(start, *split(spoiled), 1, threads=1)
    assert first.evaluated == VIEWS
    assert first.gain_db != 0.0
    assert first == second


def test_the_result_does_not_depend_on_the_threads() -> None:
    start, views = untrained(glossy(1)), split(photographed(glossy(1)))
    one, two = (select_harmonics(start, *views, 1, threads=n) for n in (1, 2))
    assert (one.gain_db, one.share) == (two.gain_db, two.share)
    assert one.coefficients is not None
    assert two.coefficients is not None
    assert np.array_equal(one.coefficients, two.coefficients)


def unknown(evidence: HarmonicsEvidence) -> bool:
    return (
        not evidence.needed
        and evidence.evaluated == 0
        and evidence.gain_db == evidence.share == 0.0
    )


def test_too_few_photos_decide_nothing() -> None:
    views = photographed(glossy(1))
    start = untrained(glossy(1))
    evidence = select_harmonics(start, views[:7], views[7:], 1, threads=1)  # a half of 3 photos
    assert unknown(evidence)
    assert evidence.decision().chosen == "degree 0"
    assert "Too few photos" in evidence.decision().evidence
    assert unknown(select_harmonics(start.replaced(means=start.means + 99), *split(views), 1))


def test_the_record_names_degree_and_figures() -> None:
    gloss = select_harmonics(untrained(glossy(1)), *split(photographed(glossy(1))), 1, threads=1)
    decision = gloss.decision()
    assert decision.chosen == "degree 1"
    assert f"on {100 * gloss.share:.1f} % of the well-observed surface" in decision.evidence
    assert f"cross-validated on {VIEWS} photos" in decision.evidence
    assert decision.figures["share"] == gloss.share
    assert decision.figures["limit_share"] == NEEDED_SHARE
    assert decision.figures["gain_db"] == gloss.gain_db
    assert gloss.decision("off").chosen == "degree 0"
    assert gloss.decision("on", 3).chosen == "degree 3"


def test_bad_input_is_refused() -> None:
    views = photographed(sphere_gaussians())
    with pytest.raises(UsageError, match="Degree 4"):
        select_harmonics(sphere_gaussians(), views, [], 4)
    wrong = [dataclasses.replace(views[0], photo=views[0].photo[1:]), *views[1:]]
    with pytest.raises(UsageError, match="same size"):
        select_harmonics(sphere_gaussians(), wrong, [], 1, threads=1)


def test_matching_finds_gain_and_offset() -> None:
    random = np.random.default_rng(2)
    image = random.random(size=(500, 3))
    image[:, 2] = 0.5
    gain, offset = match_exposure(image, np.array([1.2, 0.8, 1.0]) * image + 0.1)
    assert np.allclose(gain, [1.2, 0.8, 1.0])
    assert np.allclose(offset, 0.1)
    assert math.isclose(gain[2], 1.0)
