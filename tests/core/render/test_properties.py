# SPDX-License-Identifier: GPL-3.0-or-later
"""Properties of the fast renderer for any finite parameters: finite, ordered, tiled, repeatable."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.render.render import render
from gaussian_wrapping_addon.core.render.types import Render, RenderOptions
from gaussian_wrapping_addon.core.scene.camera import Camera
from tests.core.render.comparisons import judge, leaves
from tests.core.render.depth_scenes import joined
from tests.core.render.first_principles import IMAGES, TRAINED
from tests.core.render.scenes import look_at, random_gaussians
from tests.poses import look_at_pose


def steady(examples: int) -> settings:
    """The same examples in every run, and no clock: machines differ."""
    return settings(
        derandomize=True,
        deadline=None,
        database=None,
        max_examples=examples,
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
    )


COUNT = 5
BACKGROUND = (0.25, 0.5, 0.75)
COLUMNS = {"means": 3, "log_scales": 3, "quats": 4, "opacity_logits": 1, "sh": 12, "orientation": 4}
LIMIT = float(np.finfo(np.float32).max)
seeds = st.integers(0, 2**31)


def finite(low: float, high: float) -> st.SearchStrategy[float]:
    """float32 values, the unpleasant ones often."""
    hard = [0.0, -0.0, 1e-45, -1e-45, 1e-38, 1e-30, 1e-12, 1.0, 1e3, 1e6, 1e12, 1e19, 1e20]
    hard += [50.0, 80.0, 1e30, LIMIT]
    hard += [-value for value in hard]
    return st.one_of(
        st.sampled_from([value for value in hard if low <= value <= high]),
        st.floats(low, high, width=32, allow_nan=False, allow_infinity=False),
    )


@st.composite
def wild_gaussians(draw: st.DrawFn) -> OrientedGaussians:
    """A sane scene in which some values, or whole columns, are any finite float32."""
    gaussians = random_gaussians(
        COUNT, draw(seeds) % 1000, sh_degree=1, dtype=torch.float32, opacity=(0.1, 0.98)
    )
    values = {name: tensor.clone().reshape(COUNT, -1) for name, tensor in gaussians.tensors()}
    change = st.tuples(
        st.sampled_from(sorted(COLUMNS)),
        st.integers(0, COUNT - 1),
        st.integers(-1, 11),
        finite(-LIMIT, LIMIT),
    )
    for name, row, column, value in draw(st.lists(change, max_size=8)):
        places = slice(None) if column < 0 else column % COLUMNS[name]
        values[name][row, places] = value
    # Without a filter nothing bounds a sigma from below.
    values["filter_3d"][:] = draw(st.one_of(st.sampled_from([0.01, 0.0]), finite(0.0, LIMIT)))
    return OrientedGaussians(
        **{name: values[name].reshape(tensor.shape) for name, tensor in gaussians.tensors()}
    )


@st.composite
def cameras(draw: st.DrawFn) -> Camera:
    """Sane cameras, and cameras with absurd positions and lenses."""
    width, height = draw(st.integers(1, 36)), draw(st.integers(1, 33))
    focal = draw(st.sampled_from([20.0, 45.0, 300.0, 1e-6, 1e9]))
    center = st.sampled_from([0.5, 0.3, -2.0, 1e4, -1e9])
    eye = np.random.default_rng(draw(seeds)).normal(size=3)
    eye *= draw(st.sampled_from([1.0, 3.0, 1e-6, 1e4, 1e12]))
    aspect = draw(st.sampled_from([1.0, 0.2, 1e4]))
    cx, cy = width * draw(center), height * draw(center)
    return Camera("any", width, height, focal, focal * aspect, cx, cy, look_at_pose(eye))


def run(
    gaussians: OrientedGaussians, camera: Camera, options: RenderOptions
) -> tuple[Render, dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Render and differentiate with moderate random upstream gradients."""
    leaf = leaves(gaussians, torch.float32)
    view = render(leaf, camera, options)
    generator = torch.Generator().manual_seed(3)
    images = [getattr(view, name) for name in IMAGES]
    torch.autograd.backward(
        images, [torch.randn(image.shape, generator=generator) for image in images]
    )
    return (
        view,
        {name: image.detach().numpy() for name, image in zip(IMAGES, images, strict=True)},
        {name: getattr(leaf, name).grad.numpy() for name in TRAINED},
    )


@steady(300)
@given(
    gaussians=wild_gaussians(),
    camera=cameras(),
    near_z=st.sampled_from([0.2, 0.0, 1e-6, -1.0]),
    depth=st.booleans(),
    statistics=st.booleans(),
)
def test_finite_parameters_give_finite_images_and_gradients(
    gaussians: OrientedGaussians, camera: Camera, near_z: float, depth: bool, statistics: bool
) -> None:
    options = RenderOptions(
        depth=depth, near_z=near_z, statistics=statistics, threads=1, background=BACKGROUND
    )
    view, images, gradients = run(gaussians, camera, options)
    for name, image in images.items():
        assert np.isfinite(image).all(), name
    assert images["alpha"].min() >= 0.0
    assert images["alpha"].max() <= 1.0
    assert images["depth"].min() >= 0.0
    # Normals are averages of vectors no longer than 1.
    for name in ("normal", "geometric_normal"):
        assert np.linalg.norm(images[name], axis=2).max() <= 1.0 + 1e-5, name
    for name, gradient in gradients.items():
        assert np.isfinite(gradient).all(), name
    # Where nothing is seen there is the background, and nothing else.
    empty = images["alpha"] == 0.0
    assert (images["color"][empty] == np.float32(BACKGROUND)).all()
    for name in ("normal", "geometric_normal", "depth"):
        assert not images[name][empty].any(), name
    if view.statistics is not None:
        for name in ("radii_px", "weight_sum", "weight_max"):
            assert np.isfinite(getattr(view.statistics, name)).all(), name


def one_wild(**values: float | list[float]) -> OrientedGaussians:
    """One plain Gaussian with some parameters replaced."""
    gaussians = random_gaussians(1, 3, sh_degree=0, dtype=torch.float32, spread=0.1)
    for name, value in values.items():
        getattr(gaussians, name)[:] = torch.tensor(value)
    return gaussians


PLAIN = look_at((0.3, -3.0, 0.2), width=20, height=18)
FAR_CENTER = replace(PLAIN, cx=1e30, cy=-1e30)
ZOOMED = replace(PLAIN, fx=1e9, fy=1e9)
# A ball around the camera, on every pixel of every image.
AROUND = {"log_scales": 1.5, "means": [0.0, -2.5, 0.0], "filter_3d": 0.0}
ABSURD = {
    "principal point 1e30 px away": (one_wild(**AROUND), FAR_CENTER),
    "harmonics of 3e38": (one_wild(sh=3e38), PLAIN),
    "harmonics of 1e30 on 1e9 px": (one_wild(sh=1e30, means=0.03), ZOOMED),
    "harmonics of -3e38": (one_wild(sh=-3e38), PLAIN),
    "sigma from 1e-20 to 1e23": (
        one_wild(
            means=[0.02, 0.0, 0.05],
            log_scales=[0.8, -46.8, 52.3],
            quats=[0.9, 0.3, 0.1, 0.2],
            filter_3d=0.0,
            opacity_logits=3.4,
        ),
        PLAIN,
    ),
    "sigma of 1e-19 to 1e5": (
        one_wild(log_scales=[-11.5, -44.4, 11.8], quats=[0.9, 0.3, 0.1, 0.2], filter_3d=0.0),
        PLAIN,
    ),
    "log scales of -1e30": (one_wild(log_scales=-1e30), PLAIN),
    "log scales of -1e30 without filter": (one_wild(log_scales=-1e30, filter_3d=0.0), PLAIN),
    "log scales of 1e30": (one_wild(log_scales=1e30), PLAIN),
    "log scales of 80": (one_wild(log_scales=80.0), PLAIN),
    "opacity logit of 1e30": (one_wild(opacity_logits=1e30), PLAIN),
    "opacity logit of -1e30": (one_wild(opacity_logits=-1e30), PLAIN),
    "quaternion of 3e38": (one_wild(quats=3e38), PLAIN),
    "quaternion of 1e-45": (one_wild(quats=1e-45), PLAIN),
    "orientation of 3e38": (one_wild(orientation=3e38), PLAIN),
    "mean at 3e38": (one_wild(means=3e38), PLAIN),
    "mean at the camera": (one_wild(means=[0.3, -3.0, 0.2]), PLAIN),
    "filter of 3e38": (one_wild(filter_3d=3e38), PLAIN),
    "filter of 1e-45": (one_wild(filter_3d=1e-45, log_scales=-1e30), PLAIN),
    "largest values everywhere": (
        one_wild(sh=3e38, log_scales=3e38, quats=3e38, orientation=3e38, opacity_logits=3e38),
        PLAIN,
    ),
    # Its least den is 3e-12, far below the rounding of den's terms: gradients overflow.
    "sigma of 1e12 around everything": (
        one_wild(
            log_scales=[27.25, 27.05, 31.4], filter_3d=0.0, quats=[0.9, 0.3, 0.1, 0.2], sh=1e6
        ),
        PLAIN,
    ),
    "disc of 1e9 : 1": (
        one_wild(log_scales=[0.0, 0.0, -20.7], filter_3d=0.0, quats=[0.9, 0.3, 0.1, 0.2]),
        PLAIN,
    ),
    "harmonics at their limit": (one_wild(sh=4e7), PLAIN),
}


@pytest.mark.parametrize("name", ABSURD)
@pytest.mark.parametrize("near_z", [0.2, 0.0, -1.0])
def test_absurd_values_stay_finite(name: str, near_z: float) -> None:
    gaussians, camera = ABSURD[name]
    options = RenderOptions(near_z=near_z, statistics=True, threads=1)
    view, images, gradients = run(joined(gaussians, one_wild()), camera, options)
    for key, image in images.items():
        assert np.isfinite(image).all(), key
    for key, gradient in gradients.items():
        assert np.isfinite(gradient).all(), key
    statistics = view.statistics
    assert statistics is not None
    for key in ("radii_px", "weight_sum", "weight_max", "grad_px", "grad_abs_px"):
        assert np.isfinite(getattr(statistics, key)).all(), key
    if camera is PLAIN:
        # The plain one behind it is not lost.
        assert statistics.visible[1]
        assert gradients["means"][1].any()


@steady(60)
@given(gaussians=wild_gaussians(), camera=cameras())
def test_hidden_gaussians_leave_no_trace(gaussians: OrientedGaussians, camera: Camera) -> None:
    options = RenderOptions(threads=1, statistics=True)
    view, images, gradients = run(gaussians, camera, options)
    assert view.statistics is not None
    seen = torch.from_numpy(view.statistics.visible)
    for gradient in gradients.values():
        assert not gradient[~view.statistics.visible].any()
    _, alone, _ = run(gaussians.select(seen), camera, options)
    for name in IMAGES:
        np.testing.assert_array_equal(alone[name], images[name], err_msg=name)


@steady(60)
@given(seed=seeds, wild=st.booleans(), data=st.data())
def test_order_of_storage_does_not_matter(seed: int, wild: bool, data: st.DataObject) -> None:
    if wild:
        gaussians = data.draw(wild_gaussians())
        # Distances that differ: means on a spiral.
        step = torch.arange(COUNT, dtype=torch.float32)
        means = torch.stack([0.3 * torch.cos(step), 0.2 * step, 0.3 * torch.sin(step)], 1)
        gaussians = gaussians.replaced(means=means)
    else:
        gaussians = random_gaussians(40, seed % 1000, dtype=torch.float32)
    camera = look_at((0.3, -3.0, 0.2), width=35, height=20)
    order = torch.randperm(len(gaussians), generator=torch.Generator().manual_seed(seed))
    distance = (gaussians.means.double() - torch.from_numpy(camera.center)).norm(dim=1).float()
    assert len(distance.unique()) == len(distance)
    _, images, gradients = run(gaussians, camera, RenderOptions())
    _, shuffled, moved = run(gaussians.select(order), camera, RenderOptions())
    for name in IMAGES:
        np.testing.assert_array_equal(shuffled[name], images[name], err_msg=name)
    for name in TRAINED:
        np.testing.assert_array_equal(moved[name], gradients[name][order.numpy()], err_msg=name)


@steady(25)
@given(seed=seeds, wild=st.booleans(), width=st.integers(1, 90), height=st.integers(1, 70))
def test_bitwise_the_same_for_any_number_of_threads(
    seed: int, wild: bool, width: int, height: int
) -> None:
    count = 300 if wild else 60
    gaussians = random_gaussians(
        count, seed % 1000, dtype=torch.float32, scale=(1e-4, 2.0) if wild else (0.03, 0.2)
    )
    camera = look_at((1.6, 1.0, 0.4), width=width, height=height, focal=40.0)
    results = []
    for threads in (1, 2, 4):
        view, images, gradients = run(
            gaussians, camera, RenderOptions(threads=threads, statistics=True)
        )
        names = ("visible", "radii_px", "weight_sum", "weight_max", "grad_px", "grad_abs_px")
        figures = {f"{name} figure": getattr(view.statistics, name) for name in names}
        results.append({**images, **gradients, **figures})
    for other in results[1:]:
        for name, value in results[0].items():
            np.testing.assert_array_equal(other[name], value, err_msg=name)


@steady(40)
@given(
    seed=seeds,
    split_x=st.integers(1, 39),
    split_y=st.integers(1, 29),
    eye=st.sampled_from([(2.2, 1.0, 0.8), (0.2, 0.1, 0.0)]),
)
def test_crops_are_the_whole(
    seed: int, split_x: int, split_y: int, eye: tuple[float, float, float]
) -> None:
    """Images of four crops, and the sum of their gradients, are those of the whole image.

    The depth's threshold of the final transmittance, and alphas at 1/255, may fall either way by
    rounding; the scenes' shares of such pixels are bounded instead.
    """
    gaussians = random_gaussians(30, seed % 1000, dtype=torch.float32)
    camera = look_at(eye, width=40, height=30)
    options = RenderOptions(threads=1)
    with torch.no_grad():
        whole = render(gaussians, camera, options)
        for left, width in ((0, split_x), (split_x, 40 - split_x)):
            for top, height in ((0, split_y), (split_y, 30 - split_y)):
                crop = replace(
                    camera, width=width, height=height, cx=camera.cx - left, cy=camera.cy - top
                )
                part = render(gaussians, crop, options)
                for name in IMAGES:
                    one = getattr(part, name).numpy()
                    other = getattr(whole, name).numpy()[top : top + height, left : left + width]
                    far = abs(one - other) > (3e-5 if name == "depth" else 3e-6)
                    assert far.sum() <= 2 + 0.002 * far.size, name
                    if name != "depth":
                        assert abs(one - other).max() < 2.0 / 255.0 * 2.0, name


@steady(25)
@given(
    seed=seeds,
    degree=st.integers(0, 3),
    width=st.integers(1, 40),
    height=st.integers(1, 30),
    focal=st.sampled_from([5.0, 20.0, 60.0]),
    smallest=st.sampled_from([0.005, 0.05, 0.3]),
    faint=st.booleans(),
)
def test_any_sane_view_is_the_definition(
    seed: int, degree: int, width: int, height: int, focal: float, smallest: float, faint: bool
) -> None:
    gaussians = random_gaussians(
        40,
        seed % 1000,
        sh_degree=degree,
        scale=(smallest, 0.6),
        opacity=(0.01, 0.2) if faint else (0.2, 0.999),
    )
    eye = np.random.default_rng(seed).normal(size=3) * 1.5
    camera = look_at(tuple(eye), width=width, height=height, focal=focal)
    verdict = judge(gaussians, camera)
    verdict.assert_within(blended=2e-5, depth=1e-4, gradient=1e-3, depth_gradient=1e-2, clear=0.9)
