# SPDX-License-Identifier: GPL-3.0-or-later
"""Losses of the CUDA text, emulated or on a GPU, equal those of the compiled CPU kernels."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch import Tensor

from gaussian_wrapping_addon.core.gaussians.model import OrientedGaussians
from gaussian_wrapping_addon.core.image_metrics import RADIUS
from gaussian_wrapping_addon.core.render.cuda import kernels
from gaussian_wrapping_addon.core.render.cuda.kernels import Kernels, cuda_available, device_kernels
from gaussian_wrapping_addon.core.render.projection import RawArrays
from gaussian_wrapping_addon.core.render.types import RenderOptions
from gaussian_wrapping_addon.core.render.view_renderer import ViewRenderer
from gaussian_wrapping_addon.core.scene.camera import Camera
from gaussian_wrapping_addon.core.stereo.depth_maps import DepthPrior
from gaussian_wrapping_addon.core.training import adam, device_losses, multi_view
from gaussian_wrapping_addon.core.training import losses as prior_module
from gaussian_wrapping_addon.core.training.device_losses import (
    choose_on_device,
    device_color_loss,
    device_multi_view_losses,
    device_normal_losses,
    device_prior_loss,
    grey_on_device,
)
from gaussian_wrapping_addon.core.training.losses import (
    MIN_NORMAL_SQ,
    color_loss,
    depth_prior_loss,
    normal_losses,
)
from gaussian_wrapping_addon.core.training.multi_view import (
    MultiViewLoss,
    MultiViewOptions,
    PhotoView,
    choose_pixels,
    grey_image,
    multi_view_losses,
)
from gaussian_wrapping_addon.core.training.multi_view_kernels import KEPT
from tests.core.device_kernels import DEVICES, kernels_of
from tests.core.render.comparisons import relative_l2
from tests.core.render.cuda.emulation import EmulatedKernels
from tests.core.training.plane_scene import camera_pair, plane_gaussians, plane_photo

# -- Losses of the CUDA text, emulated or on a GPU, equal those of the compiled CPU kernels -------

SIZES = [(33, 17), (48, 40), (16, 16), (70, 11), (9, 30)]


def random_camera(width: int, height: int, seed: int) -> Camera:
    random = np.random.default_rng(seed)
    rotation = np.linalg.qr(random.normal(size=(3, 3)))[0]
    rotation *= np.sign(np.linalg.det(rotation))
    pose = np.concatenate([rotation, random.normal(size=(3, 1))], 1)
    center = (0.47 * width, 0.52 * height)
    return Camera("a", width, height, 1.1 * width, 1.2 * width, *center, pose)


def random_mask(width: int, height: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).random((height, width)) > 0.3


def window_counts(mask: np.ndarray) -> tuple[int, int]:
    height, width = mask.shape
    inner = mask[RADIUS : height - RADIUS, RADIUS : width - RADIUS]
    return int(mask.sum()), int(inner.sum()) if min(mask.shape) > 2 * RADIUS else 0


def relative(found: torch.Tensor, wanted: np.ndarray) -> float:
    difference = found.cpu().double().numpy() - wanted
    return float(np.linalg.norm(difference) / max(np.linalg.norm(wanted), 1e-30))


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("masked", [False, True])
def test_color_loss(request, device: str, size: tuple[int, int], masked: bool) -> None:  # type: ignore[no-untyped-def]
    kernels = kernels_of(device, request)
    width, height = size
    random = np.random.default_rng(width)
    image = random.random((height, width, 3), np.float32)
    photo = random.integers(0, 256, (height, width, 3), np.uint8)
    image[2, 3] = photo[2, 3] / np.float32(255)  # no sign of the error
    mask = random_mask(width, height, 5) if masked else None
    counts = window_counts(np.ones((height, width), np.bool_) if mask is None else mask)
    wanted = color_loss(image, photo, mask, lambda_dssim=0.3, threads=1)
    value, gradient, squared = device_color_loss(
        kernels,
        on(device, image),
        on(device, photo).float() * np.float32(1.0 / 255.0),
        None if mask is None else on(device, mask),
        lambda_dssim=0.3,
        counts=counts,
    )
    assert abs(float(value) - wanted[0]) <= 2e-6 * abs(wanted[0])
    assert abs(float(squared) - wanted[2]) <= 2e-6 * wanted[2]
    assert relative(gradient, wanted[1]) < 5e-6
    if mask is not None:
        assert not gradient.cpu().numpy()[~mask].any()


@pytest.mark.parametrize("device", DEVICES)
def test_color_loss_of_a_mask_that_leaves_nothing(request, device: str) -> None:  # type: ignore[no-untyped-def]
    kernels = kernels_of(device, request)
    image = on(device, np.full((20, 20, 3), 0.5, np.float32))
    mask = on(device, np.zeros((20, 20), np.bool_))
    value, gradient, squared = device_color_loss(
        kernels, image, 0.5 * image, mask, lambda_dssim=0.2, counts=(0, 0)
    )
    assert float(value) == 0.0
    assert float(squared) == 0.0
    assert not gradient.any()


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("masked", [False, True])
def test_normal_losses(request, device: str, size: tuple[int, int], masked: bool) -> None:  # type: ignore[no-untyped-def]
    kernels = kernels_of(device, request)
    width, height = size
    random = np.random.default_rng(height)
    camera = random_camera(width, height, 3)
    depth = (2.0 + 0.1 * random.random((height, width))).astype(np.float32)
    depth[random.random((height, width)) > 0.95] = 0.0
    alpha = random.random((height, width), np.float32)
    alpha[1, 1] = 0.0
    normals = [random.normal(size=(height, width, 3)).astype(np.float32) for _ in range(2)]
    mask = random_mask(width, height, 7) if masked else None
    value, wanted = normal_losses(
        depth, *normals, alpha, camera, mask, lambda_depth_normal=0.7, lambda_normal=0.4, threads=1
    )
    found_value, found = device_normal_losses(
        kernels,
        on(device, depth),
        *(on(device, normal) for normal in normals),
        on(device, alpha),
        camera,
        None if mask is None else on(device, mask),
        lambda_depth_normal=0.7,
        lambda_normal=0.4,
        pixels=width * height if mask is None else int(mask.sum()),
    )
    assert abs(value) > 1e-4
    assert abs(float(found_value) - value) <= 3e-5 * abs(value) + 1e-6
    for name in ("depth", "geometric_normal", "normal", "alpha"):
        # 5e-5: the normal of a nearly flat depth is a difference of nearly equal float32.
        assert relative(getattr(found, name), getattr(wanted, name)) < 5e-5, name


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("masked", [False, True])
def test_prior_loss(request, device: str, masked: bool) -> None:  # type: ignore[no-untyped-def]
    kernels = kernels_of(device, request)
    random = np.random.default_rng(4)
    camera, other = random_camera(37, 23, 1), random_camera(18, 11, 1)
    there = np.full((11, 18), 2.0, np.float32)
    there[random.random((11, 18)) > 0.9] = 0.0
    depth = (2.0 * (1.0 + 0.04 * random.normal(size=(23, 37)))).astype(np.float32)
    depth[3, :5] = 0.0
    confidence = random.random((11, 18)).astype(np.float32)
    mask = random_mask(37, 23, 2) if masked else None
    prior = DepthPrior(other, there, confidence, there, there)
    value, wanted = depth_prior_loss(depth, camera, prior, mask, weight=0.8, threads=1)
    found_value, found = device_prior_loss(
        kernels,
        on(device, depth),
        camera,
        (on(device, there), on(device, confidence), other),
        None if mask is None else on(device, mask),
        weight=0.8,
        pixels=depth.size if mask is None else int(mask.sum()),
    )
    assert value > 0.0
    assert abs(float(found_value) - value) <= 2e-6 * value
    assert found.depth is not None
    assert wanted.depth is not None
    assert relative(found.depth, wanted.depth) < 1e-6


def test_the_source_has_the_numbers_of_the_cpu_kernels() -> None:
    text = kernels.cuda_source()
    for name, value in {
        "MIN_NORMAL_SQ": MIN_NORMAL_SQ,
        "ADAM_BETA1": adam.BETA1,
        "ADAM_BETA2": adam.BETA2,
        "ADAM_EPSILON": adam.EPSILON,
    }.items():
        assert f"#define {name} {value!r}f\n" in text
    assert f"#define PRIOR_TOLERANCE {prior_module.TOLERANCE_SHARE!r}\n" in text
    assert f"#define PRIOR_OUTLIER {prior_module.OUTLIER_SHARE!r}\n" in text


def on(device: str, array: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(array)).to("cuda" if device == "cuda" else "cpu")


# -- Multi-view losses of the CUDA text, emulated on the host or on a GPU, equal those of the CPU -

REFERENCE, OTHER = camera_pair()
OPTIONS = MultiViewOptions(0.6, 0.3, "signed", 400, weight=2.0)
TRAINED = ("means", "log_scales", "quats", "opacity_logits")


def bytes_of(camera: Camera, *, contrast: float = 0.4) -> np.ndarray:
    """Return the (h, w, 3) uint8 photo of the plane, not quite grey."""
    photo = 255.0 * plane_photo(camera, contrast=contrast) * [1.0, 0.9, 0.8]
    return np.round(photo).astype(np.uint8)


@dataclass(frozen=True)
class Case:
    """Inputs of both implementations."""

    gaussians: OrientedGaussians
    options: MultiViewOptions = OPTIONS
    camera: Camera = REFERENCE
    other: Camera = OTHER
    mask: np.ndarray | None = None
    other_mask: np.ndarray | None = None
    spoil: bool = False
    """Make some pixels of the images not finite."""

    def images(self) -> SimpleNamespace:
        """Return the rendered images as arrays, the depths not quite those of the Gaussians.

        Both views render the same surface: without that, the reprojection error is rounding, and
        so is the direction in which its gradient points.
        """
        raw = RawArrays.from_gaussians(self.gaussians)
        view = ViewRenderer().render(raw, self.camera, RenderOptions(sh_degree=0))
        depth, normal = view.depth.copy(), view.geometric_normal.copy()
        row, column = np.indices(depth.shape)
        depth *= (1.0 + 0.004 * (2.0 + np.cos(column / 9.0 + row / 7.0))).astype(np.float32)
        if self.spoil:
            normal[20:24] = np.nan
            depth[30, :] = np.inf
        return SimpleNamespace(depth=depth, geometric_normal=normal, alpha=view.alpha.copy())

    def on_cpu(self, images: SimpleNamespace) -> MultiViewLoss:
        """Return the CPU's losses."""
        return multi_view_losses(
            images, RawArrays.from_gaussians(self.gaussians),
            PhotoView(self.camera, bytes_of(self.camera), self.mask),
            PhotoView(self.other, bytes_of(self.other), self.other_mask), self.options,
            np.random.default_rng(1), threads=1,
        )  # fmt: skip

    def on_device(
        self, kernels: Kernels, images: SimpleNamespace, device: str = "cpu"
    ) -> MultiViewLoss:
        """Return the losses of the CUDA text."""

        def there(array: np.ndarray | None) -> Tensor | None:
            return None if array is None else torch.from_numpy(array).to(device)

        gaussians = {name: tensor.to(device) for name, tensor in self.gaussians.tensors()}
        return device_multi_view_losses(
            kernels,
            SimpleNamespace(**{name: there(array) for name, array in vars(images).items()}),
            OrientedGaussians(**gaussians),
            PhotoView(self.camera, there(bytes_of(self.camera)), there(self.mask)),
            PhotoView(self.other, there(bytes_of(self.other)), there(self.other_mask)),
            self.options,
            np.random.default_rng(1),
        )  # fmt: skip


def values_of(loss: MultiViewLoss) -> list[Tensor]:
    """Return everything that must be reproduced."""
    gradients = loss.gradients
    return [
        loss.value,
        gradients.depth,
        gradients.geometric_normal,
        *(loss.other or {}).values(),
        loss.figures.photometric,
        loss.figures.geometric,
    ]


def errors_of(case: Case, kernels: Kernels, device: str = "cpu") -> dict[str, float]:
    """Compare both; return relative errors of the value and, in L2, of the gradients.

    The counts of pixels and the pixels with a gradient are the same.
    """
    images = case.images()
    found, wanted = case.on_device(kernels, images, device), case.on_cpu(images)
    assert all(torch.isfinite(value).all() for value in values_of(found))
    for name in ("chosen", "valid", "kept"):
        assert int(getattr(found.figures, name)) == getattr(wanted.figures, name), name
    errors = {
        "value": abs(float(found.value) - wanted.value) / max(wanted.value, 1e-12),
        "photometric": abs(float(found.figures.photometric) - wanted.figures.photometric),
        "geometric": abs(float(found.figures.geometric) - wanted.figures.geometric),
    }
    for name in ("depth", "geometric_normal"):
        a, b = getattr(found.gradients, name).cpu().numpy(), getattr(wanted.gradients, name)
        assert np.array_equal(a != 0, b != 0), name
        errors[name] = relative_l2(a, b)
    for name in TRAINED if found.other is not None else ():
        dense = np.zeros(getattr(case.gaussians, name).shape, np.float32)
        if wanted.other is not None:
            dense[wanted.other.ids] = getattr(wanted.other, name)
        errors[name] = relative_l2(found.other[name].cpu().numpy(), dense)  # type: ignore[index]
    if wanted.other is not None:
        assert found.other is not None
    return errors


def assert_same(
    case: Case, kernels: Kernels, device: str = "cpu", *, gaussians: float = 1e-4
) -> None:
    """Compare both; ``gaussians`` is the tolerance of the gradients on the Gaussians."""
    errors = errors_of(case, kernels, device)
    assert errors.pop("value") < 1e-5
    assert errors.pop("photometric") < 1e-6
    assert errors.pop("geometric") < 1e-5
    for name, error in errors.items():
        assert error < (gaussians if name in TRAINED else 1e-4), f"{name}: {error}"


def cases() -> dict[str, Case]:
    random = np.random.default_rng(3)
    ours = random.uniform(size=(REFERENCE.height, REFERENCE.width)) < 0.97
    theirs = random.uniform(size=(OTHER.height, OTHER.width)) < 0.97
    noisy = plane_gaussians(noise=0.03)
    pose = OTHER.cam_from_world.copy()
    pose[0], pose[2] = -pose[0], -pose[2]
    away = dataclasses.replace(OTHER, cam_from_world=pose)
    replaced = dataclasses.replace
    thin = noisy.replaced(log_scales=noisy.log_scales - torch.tensor([0.0, 0.0, 4.0]))
    return {
        "noisy": Case(noisy),
        "squared, large patches": Case(
            noisy, replaced(OPTIONS, correlation="squared", patch_sizes=3, min_contrast=0.08)
        ),
        "masks": Case(noisy, mask=ours, other_mask=theirs),
        "thin layers": Case(thin),
        "not finite": Case(noisy, spoil=True),
        "all pixels": Case(noisy, replaced(OPTIONS, pixels=REFERENCE.width * REFERENCE.height)),
        "odd sizes": Case(
            noisy,
            camera=REFERENCE.resized(33, 17),
            other=OTHER.resized(37, 19),
        ),
        "photometric alone": Case(noisy, replaced(OPTIONS, lambda_geometric=0.0)),
        "geometric alone": Case(noisy, replaced(OPTIONS, lambda_photometric=0.0)),
        "looks away": Case(noisy, other=away),
        "nothing is chosen": Case(noisy, mask=np.zeros_like(ours)),
        "all masked there": Case(noisy, other_mask=np.zeros_like(theirs)),
        "no gaussians": Case(noisy.select(torch.zeros(len(noisy), dtype=torch.bool))),
    }


CASES = cases()


# A float32 depth of 3 is rounded by a thousandth of the thin layers' sigma.
TOLERANCES = {"thin layers": 2e-3}


@pytest.mark.parametrize("name", CASES)
def test_emulated_losses_equal_the_cpu(emulator_library: Path, name: str) -> None:
    kernels = EmulatedKernels(emulator_library)
    assert_same(CASES[name], kernels, gaussians=TOLERANCES.get(name, 1e-4))


@pytest.mark.parametrize("name", ["noisy", "masks"])
def test_disturbed_exponentials_change_little(emulator_library: Path, name: str) -> None:
    assert_same(CASES[name], EmulatedKernels(emulator_library, ulp=1.0))


def test_the_order_of_the_threads_does_not_matter(emulator_library: Path) -> None:
    for name in ("masks", "squared, large patches"):
        case = CASES[name]
        images = case.images()
        one, two = (
            values_of(case.on_device(EmulatedKernels(emulator_library, backwards=b), images))
            for b in (False, True)
        )
        for a, b in zip(one, two, strict=True):
            assert torch.equal(a, b)


def assert_same_pixels(kernels: Kernels, device: str = "cpu") -> None:
    random = np.random.default_rng(0)
    for seed, (width, height) in enumerate(
        [(33, 17), (64, 48), (8, 8), (5, 5), (4, 30), (101, 57)]
    ):
        shape = (height, width)
        photo = random.integers(0, 256, (*shape, 3), dtype=np.uint8)
        photo[:, width // 2 :] = 90
        depth = np.where(random.uniform(size=shape) < 0.8, 2.0, 0.0).astype(np.float32)
        depth[random.uniform(size=shape) < 0.05] = np.nan
        mask = random.uniform(size=shape) < 0.9
        wanted_grey = grey_image(photo, "grey", threads=1)
        grey = grey_on_device(kernels, torch.from_numpy(photo).to(device))
        assert np.array_equal(grey.cpu().numpy(), wanted_grey)
        for given in (None, mask, np.zeros_like(mask)):
            for count in (40, width * height // 3, width * height):
                draws = [np.random.default_rng(seed) for _ in range(2)]
                wanted = choose_pixels(wanted_grey, depth, given, count, draws[0], threads=1)
                there = np.zeros(0, np.bool_) if given is None else given
                found = choose_on_device(
                    kernels, grey, torch.from_numpy(depth).to(device),
                    torch.from_numpy(there).to(device), count, draws[1],
                ).cpu().numpy()  # fmt: skip
                assert len(found) == min(count, width * height)
                assert np.array_equal(found[found >= 0], wanted)
                assert draws[0].random() == draws[1].random()


def test_the_same_pixels_are_chosen(emulator_library: Path) -> None:
    assert_same_pixels(EmulatedKernels(emulator_library))


def assert_same_steps(case: Case, kernels: Kernels, device: str = "cpu") -> None:
    """Compare what each kernel writes, given the CPU's depths."""
    images = case.images()
    height, width = images.depth.shape
    pixels = np.arange(0, height * width, 3, dtype=np.int32)
    near_z, options = RenderOptions().near_z, case.options
    ours = multi_view._ViewPair(images, case.camera, case.other, pixels, near_z, 1)
    empty = np.zeros((0, 0), np.bool_)
    masks = [empty if mask is None else mask for mask in (case.mask, case.other_mask)]
    greys = [grey_image(bytes_of(c), "grey", threads=1) for c in (case.camera, case.other)]

    def there(array: np.ndarray) -> Tensor:
        return torch.from_numpy(array).to(device)

    pair = device_losses._Pair(kernels, there(pixels), case.camera, case.other, near_z)
    wanted = ours.lift(masks[1])
    found = pair.lift(there(images.depth), there(masks[1]))
    np.testing.assert_allclose(found[0].cpu(), wanted[0], rtol=1e-6)
    np.testing.assert_allclose(found[1].cpu(), wanted[1], rtol=1e-12, atol=1e-12)
    # Depths of the plane, off by so much that some pixels do not return to within one.
    random = np.random.default_rng(5)
    depths = (images.depth.ravel()[pixels] * random.uniform(0.9, 1.1, len(pixels))).astype("f4")
    wanted = ours.reproject(wanted[0], depths)
    found = pair.reproject(found[0], there(depths))
    noise = wanted[0]
    assert 100 < np.isfinite(noise).sum() < len(pixels)
    assert np.array_equal(np.isinf(found[0].cpu()), np.isinf(noise))
    for a, b in zip((found[0], *found[2:]), wanted, strict=True):
        np.testing.assert_allclose(a.cpu(), b, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(found[1].cpu(), np.exp(-noise), rtol=1e-6)
    wanted = ours.compare(noise, tuple(greys), tuple(masks), options)  # type: ignore[arg-type]
    normal, alpha = there(images.geometric_normal), there(images.alpha)
    found = pair.compare(
        there(noise),
        (there(images.depth), normal, alpha),
        (there(greys[0]), there(greys[1])),
        (there(masks[0]), there(masks[1])),
        options,
    )
    assert np.array_equal(found[0].cpu(), wanted[0])
    assert 50 < (wanted[0] == KEPT).sum() < np.isfinite(noise).sum()
    for a, b in zip(found[1:], wanted[1:], strict=True):
        np.testing.assert_allclose(a.cpu(), b, rtol=1e-9, atol=1e-9 * np.abs(b).max())


@pytest.mark.parametrize("name", ["noisy", "squared, large patches", "masks", "not finite"])
def test_every_step_equals_the_cpu(emulator_library: Path, name: str) -> None:
    assert_same_steps(CASES[name], EmulatedKernels(emulator_library))


# -- on a GPU -------------------------------------------------------------------------------------


@pytest.fixture
def gpu() -> Kernels:
    usable, reason = cuda_available()
    if not usable:
        pytest.skip(reason)
    return device_kernels(torch.cuda.current_device())


@pytest.mark.gpu
@pytest.mark.parametrize("name", CASES)
def test_losses_on_the_gpu_equal_the_cpu(gpu: Kernels, name: str) -> None:
    assert_same(CASES[name], gpu, "cuda", gaussians=TOLERANCES.get(name, 1e-4))


@pytest.mark.gpu
def test_the_gpu_chooses_the_same_pixels(gpu: Kernels) -> None:
    assert_same_pixels(gpu, "cuda")


@pytest.mark.gpu
@pytest.mark.parametrize("name", ["noisy", "squared, large patches", "masks", "not finite"])
def test_every_step_on_the_gpu_equals_the_cpu(gpu: Kernels, name: str) -> None:
    assert_same_steps(CASES[name], gpu, "cuda")


@pytest.mark.gpu
def test_every_run_on_the_gpu_gives_the_same_bits(gpu: Kernels) -> None:
    case = CASES["all pixels"]
    images = case.images()
    runs = [values_of(case.on_device(gpu, images, "cuda")) for _ in range(3)]
    for run in runs[1:]:
        for a, b in zip(run, runs[0], strict=True):
            assert torch.equal(a, b)
