# SPDX-License-Identifier: GPL-3.0-or-later
"""Laws of cost fitted to comparisons, and what they say of a scene that nobody has trained."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..tables import Table
from .comparison import COARSE, JOINED, MESH, WHOLE
from .record import Record
from .road import SLOTS
from .street import length_m
from .street_mesh import MESHED_M

GIB = float(2**30)
ALONE = "1 process"


@dataclass(frozen=True)
class PowerLaw:
    """``factor * photos ** exponent``, by least squares of the logarithms."""

    factor: float
    exponent: float

    @classmethod
    def of(cls, photos: Sequence[float], values: Sequence[float]) -> PowerLaw:
        """Fit at least two pairs of positive numbers."""
        exponent, offset = np.polyfit(np.log(photos), np.log(values), 1)
        return cls(math.exp(offset), float(exponent))

    def at(self, photos: float) -> float:
        """Return the value for so many photos."""
        return self.factor * float(photos) ** self.exponent


def block_figures(record: Record) -> list[Mapping[str, float]]:
    """Return the figures of a comparison's blocks, in order."""
    return [record["steps"][f"block-{k}"] for k in range(record["blocks"])]


def costs(record: Record) -> dict[str, float]:
    """Return the processor seconds of the parts of both ways."""
    steps, blocks = record["steps"], [of["processor_s"] for of in block_figures(record)]
    found = {
        WHOLE: steps[WHOLE]["processor_s"],
        COARSE: steps[COARSE]["processor_s"],
        "blocks": math.fsum(blocks),
        JOINED: steps[JOINED]["processor_s"],
    }
    found["together"] = found[COARSE] + found["blocks"] + found[JOINED]
    return found


def peaks(record: Record) -> dict[str, float]:
    """Return the largest memory of a process of each kind, bytes."""
    steps = record["steps"]
    found = {name: float(steps[name]["peak_bytes"]) for name in (WHOLE, COARSE, JOINED)}
    found["blocks"] = max(float(of["peak_bytes"]) for of in block_figures(record))
    return found


def plan_table(most: Record, curve: Sequence[Record], photos: int, machines: int) -> Table:
    """Return the plan of a scene: stages with work, time and memory.

    Parameters
    ----------
    most : Record
        Of the longest street: what it took is carried on to more photos, block by block.
    curve : sequence of Record
        Of streets of at least two lengths, with the same photos a block: their exponents.
    photos, machines : int
        Each machine has :data:`~.road.SLOTS` processors.
    """
    counts = [record["photos"] for record in curve]
    work, memory = [costs(record) for record in curve], [peaks(record) for record in curve]
    times = photos / most["photos"]

    def law(name: str) -> float:
        exponent = PowerLaw.of(counts, [of[name] for of in work]).exponent
        return costs(most)[name] * times ** max(1.0, exponent)

    def held(name: str) -> float:
        offset = float(np.polyfit(counts, [of[name] for of in memory], 1)[1])
        return (offset + times * (peaks(most)[name] - offset)) / GIB

    blocks_s = [of["processor_s"] for of in block_figures(most)]
    number = max(1, round(times * most["blocks"]))
    slots = machines * SLOTS
    rounds = math.ceil(number / slots)
    rows: list[tuple[str, str, float, float, float | None]] = [
        ("coarse training, plan", ALONE, law(COARSE), law(COARSE) / SLOTS, held(COARSE)),
        (
            f"{number} blocks", f"{min(number, slots)} processes, {rounds} rounds",
            times * math.fsum(blocks_s), rounds * max(blocks_s), peaks(most)["blocks"] / GIB,
        ),
        ("joining, polish", ALONE, law(JOINED), law(JOINED) / SLOTS, held(JOINED)),
    ]  # fmt: skip
    mesh = most["steps"].get(f"{MESH}{JOINED}")
    if mesh is not None:
        length = length_m(most["photos"])
        mesh_s = times * mesh["processor_s"] * length / min(length, MESHED_M)
        rows.append(("mesh in tiles", f"{slots} processes", mesh_s, mesh_s / slots, None))
    used_s, wall_s = (math.fsum(row[k] for row in rows) for k in (2, 3))
    alone_s = math.fsum(row[3] for row in rows if row[1] == ALONE)
    rows.append(("together", "", used_s, wall_s, None))
    rows.append(("one training instead", ALONE, law(WHOLE), law(WHOLE) / SLOTS, held(WHOLE)))
    fitted = (
        f"What {most['photos']} photos took, carried on to {times:.0f} times as many by the "
        f"exponents of {', '.join(map(str, counts))} photos, or in proportion where they are "
        "below 1, as what every process takes to start makes them so; blocks in proportion, as "
        "if none needed more photos than these; memory by lines; mesh in proportion, as if each "
        "tile took the cameras beside it, which no job does yet. "
        "Two threads of one process are taken for twice as fast as one, which they are at best. "
        "Reading and copying files, and joining tiles, are not counted."
    )
    waiting = (
        f"In one process while {machines - 1} machines wait: {alone_s / wall_s:.0%} of the time; "
        f"no number of machines makes it shorter than {alone_s / 3600:.2f} h."
    )
    return Table(
        f"On paper: {photos} photos on {machines} machines of {SLOTS} processors",
        ("stage", "where", "processor h", "wall h", "GiB of a process"),
        [
            (name, where, round(used / 3600, 2), round(wall / 3600, 2), gib and round(gib, 1))
            for name, where, used, wall, gib in rows
        ],
        (fitted, waiting),
    )
