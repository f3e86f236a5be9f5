# SPDX-License-Identifier: GPL-3.0-or-later
"""Random weights of the shapes that LPIPS has."""

from __future__ import annotations

import math
from pathlib import Path

import torch

SHAPES = {0: (64, 3, 11), 3: (192, 64, 5), 6: (384, 192, 3), 8: (256, 384, 3), 10: (256, 256, 3)}
BACKBONE, HEADS = "alexnet-owt-7be5be79.pth", "alex.pth"
State = dict[str, torch.Tensor]


def random_states(seed: int = 0) -> tuple[State, State]:
    generator = torch.Generator().manual_seed(seed)
    backbone, heads = {}, {}
    for layer, (index, (outwards, inwards, side)) in enumerate(SHAPES.items()):
        size = (outwards, inwards, side, side)
        spread = math.sqrt(2.0 / (inwards * side**2))
        backbone[f"features.{index}.weight"] = spread * torch.randn(size, generator=generator)
        backbone[f"features.{index}.bias"] = 0.1 * torch.randn(outwards, generator=generator)
        head = torch.rand((1, outwards, 1, 1), generator=generator)
        heads[f"lin{layer}.model.1.weight"] = head
    return backbone, heads


def write(folder: Path, backbone: State, heads: State) -> None:
    torch.save(backbone, folder / BACKBONE)
    torch.save(heads, folder / HEADS)
