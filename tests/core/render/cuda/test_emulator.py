# SPDX-License-Identifier: GPL-3.0-or-later
"""The emulator detects missing barriers and deadlocked threads."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch

from gaussian_wrapping_addon.core.render.cuda.kernels import Kernels, cuda_source
from gaussian_wrapping_addon.core.render.types import RenderOptions
from tests.core.render.cuda.comparison import emulated, outcome, random_weights
from tests.core.render.cuda.emulation import EmulatedKernels, build_emulator
from tests.core.render.scenes import look_at, random_gaussians

HEAD = "typedef long long int64;\n"
ENTRY = 'extern "C" __global__ void {name}({arguments}) {{ {body} }}\n'


def library(folder: Path, arguments: str, body: str) -> Path:
    """Compile a text with one kernel, ``probe``."""
    return build_emulator(
        folder, HEAD + ENTRY.format(name="probe", arguments=arguments, body=body), ("probe",)
    )


def test_operations_of_diverged_warps(tmp_path: Path) -> None:
    # Half of the lanes come to each operation later, by another path, and loops of different
    # lengths lie between them.
    body = """
        const int lane = threadIdx.x & 31;
        float value = (float)threadIdx.x;
        unsigned seen = 0;
        if (lane & 1) { for (int i = 0; i < lane; ++i) value += 1.0f; }
        for (int k = 16; k > 0; k >>= 1) value += __shfl_xor_sync(~0u, value, k);
        if (lane < 7) seen = __ballot_sync(~0u, 1); else seen = __ballot_sync(~0u, 0);
        const int third = __shfl_sync(~0u, lane * 10, 3);
        __syncthreads();
        out[4 * threadIdx.x] = value;
        out[4 * threadIdx.x + 1] = (float)seen;
        out[4 * threadIdx.x + 2] = (float)third;
        out[4 * threadIdx.x + 3] = (float)__syncthreads_and(threadIdx.x < 300);
    """
    built = library(tmp_path, "float* out", body)
    for backwards in (False, True):
        out = torch.zeros((256, 4))
        EmulatedKernels(built, backwards=backwards).launch("probe", 1, out)
        warps = torch.arange(256).reshape(8, 32).sum(1) + sum(range(1, 32, 2))
        assert torch.equal(out[:, 0], warps.repeat_interleave(32).float())
        assert (out[:, 1] == 127.0).all()
        assert (out[:, 2] == 30.0).all()
        assert (out[:, 3] == 1.0).all()


def test_threads_that_wait_for_ever_are_reported(tmp_path: Path) -> None:
    built = library(tmp_path, "int apart", "if (threadIdx.x != apart) __syncthreads();")
    kernels: Kernels = EmulatedKernels(built)
    kernels.launch("probe", 1, 1000)
    with pytest.raises(AssertionError, match="wait for ever"):
        kernels.launch("probe", 1, 5)


def test_shared_memory_starts_as_nan(tmp_path: Path) -> None:
    body = """
        __shared__ float box[256];
        out[256 * blockIdx.x + threadIdx.x] = box[threadIdx.x];
        box[threadIdx.x] = 1.0f;
    """
    out = torch.zeros(512)
    EmulatedKernels(library(tmp_path, "float* out", body)).launch("probe", 2, out)
    assert torch.isnan(out).all()


@pytest.mark.proof
@pytest.mark.parametrize("kernel", ["forward_tile(", "backward_tile("])
def test_every_barrier_of_the_tiles_is_needed(tmp_path: Path, kernel: str) -> None:
    # Without any one of them, the order of the threads decides what comes out.
    text = cuda_source()
    begin = text.index(kernel)
    stop = text.index("\n}\n", begin)
    barriers = [begin + m.start() for m in re.finditer(r"__syncthreads\(\);", text[begin:stop])]
    assert len(barriers) == (2 if kernel.startswith("forward") else 3)
    for number, place in enumerate(barriers):
        broken = text[:place] + text[place + len("__syncthreads();") :]
        folder = tmp_path / str(number)
        folder.mkdir()
        built = build_emulator(folder, broken)
        assert betrayed(built), f"barrier {number}"


def betrayed(library: Path) -> bool:
    """Return whether two orders of the threads differ, give NaN, or leave threads waiting."""
    try:
        one, two = (rendered(EmulatedKernels(library, backwards=b)) for b in (False, True))
    except AssertionError as error:
        return "wait for ever" in str(error)
    return not all(torch.equal(a, b) and a.isfinite().all() for a, b in zip(one, two, strict=True))


def rendered(kernels: Kernels) -> list[torch.Tensor]:
    gaussians = random_gaussians(150, seed=2, dtype=torch.float32, scale=(0.05, 0.4))
    camera = look_at((2.2, 1.0, 0.8), width=20, height=18, focal=24.0)
    options = RenderOptions(depth=False)
    found = outcome(
        emulated(kernels), gaussians, camera, options, weights=random_weights(camera, options)
    )
    return found.values()
