# SPDX-License-Identifier: GPL-3.0-or-later
"""Families of single things: what a seed makes of each.

``pixel`` is the length that a pixel of the photos covers at the thing, ``variant`` chooses the kind
of thing, so that a few scenes of a family have them all; the rest is drawn.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..scenes.geometry import Part, box, cone, icosphere
from . import shapes
from .looks import GLAZED, MATTE, MIRROR, Look, Subject, draw_look
from .shapes import Mesh, about, part

DIAGONAL = 2.0
"""Of every thing's box."""

_SCALES = (1.8, 4.0)
"""Of patterns on things."""


def _finished(parts: Sequence[Part], looks: dict[str, Look], *, reflects: bool = False) -> Subject:
    """Return the parts with the middle of their box at 0 and its diagonal :data:`DIAGONAL`."""
    vertices = np.concatenate([p.vertices for p in parts])
    low, high = vertices.min(0), vertices.max(0)
    scale = DIAGONAL / float(np.linalg.norm(high - low))
    moved = [replace(p, vertices=(p.vertices - (low + high) / 2) * scale) for p in parts]
    return Subject(tuple(moved), looks, reflects)


def smooth(random: np.random.Generator, pixel: float, variant: int) -> Subject:
    """Blobs, metaballs and tori, textured all over."""
    kind = variant % 3
    looks = {f"skin{k}": draw_look(random, _SCALES) for k in range(2)}
    if kind == 0:
        mesh = shapes.blob(random, 6, random.uniform(0.25, 0.45))
        parts = [part("blob", shapes.turned(mesh, np.eye(3)), "skin0")]
    elif kind == 1:
        mesh = shapes.metaballs(random, 6)
        parts = [part("metaballs", mesh, "skin0")]
    else:
        thick = random.uniform(0.2, 0.32)
        one = shapes.turned(
            shapes.ring(0.8, thick, 96, 40), about("x", 90 + random.uniform(-30, 30))
        )
        other = shapes.turned(
            shapes.ring(0.8, 0.7 * thick, 96, 40), about("x", random.uniform(-25, 25)), (0.8, 0, 0)
        )
        parts = [part("torus 0", one, "skin0"), part("torus 1", other, "skin1")]
    return _finished(parts, looks)


def thin(random: np.random.Generator, pixel: float, variant: int) -> Subject:
    """Wheels, wire frames and lattices of rods about 1.5 to 3 pixels wide."""
    radius = 0.5 * random.uniform(1.5, 3.0) * pixel
    looks = {"frame": draw_look(random, _SCALES), "rods": draw_look(random, (4.0, 8.0))}
    kind = variant % 3
    if kind == 0:
        return _finished(_wheel(random, radius), looks)
    if kind == 1:
        vertices, faces = icosphere(0)
        edges = {
            tuple(sorted(e)) for f in faces.tolist() for e in zip(f, f[1:] + f[:1], strict=True)
        }
        turn = shapes.rotation(random)
        corners = vertices @ turn.T
        parts = [
            cone(f"rod {a} {b}", corners[a], corners[b], 1.4 * radius, 1.4 * radius, "rods", 10)
            for a, b in sorted(edges)
        ]
        ball, ball_faces = icosphere(2)
        balls = [
            part(f"ball {k}", (c + 0.06 * ball, ball_faces), "frame") for k, c in enumerate(corners)
        ]
        return _finished([*balls, *parts], looks)
    counts = random.integers(2, 5, 3)
    step = 1.5 / counts.max()
    parts = []
    for axis in range(3):
        i, j = (axis + 1) % 3, (axis + 2) % 3
        for a in range(counts[i]):
            for b in range(counts[j]):
                start = np.zeros(3)
                start[[i, j]] = step * a, step * b
                start[i] += 0.1 * radius * axis  # no two axes meet exactly
                end = start.copy()
                start[axis], end[axis] = -0.08 * step, step * (counts[axis] - 0.92)
                parts.append(
                    cone(
                        f"rod {axis}{a}{b}",
                        start,
                        end,
                        1.2 * radius,
                        1.2 * radius,
                        "rods",
                        9 + axis,
                    )
                )
    return _finished(parts, looks)


def _wheel(random: np.random.Generator, radius: float) -> list[Part]:
    """Return a wheel that stands, its axle along y, with crossing spokes."""
    upright = about("x", 90)
    spokes = 2 * int(random.integers(7, 15))
    cross, width = random.uniform(0.3, 0.9), random.uniform(0.05, 0.10)
    parts = [
        part("rim", shapes.turned(shapes.ring(0.68, random.uniform(0.03, 0.06)), upright), "frame"),
        cone("hub", (0, -1.6 * width, 0), (0, 1.6 * width, 0), 0.09, 0.09, "frame", 32),
    ]
    for k in range(spokes):
        side = 1.0 if k % 2 else -1.0
        angle = 2 * np.pi * k / spokes
        lead = angle + cross * (1.0 if k % 4 < 2 else -1.0)
        start = (0.06 * np.cos(lead), side * width, 0.06 * np.sin(lead))
        end = (0.68 * np.cos(angle), side * 0.012, 0.68 * np.sin(angle))
        parts.append(cone(f"spoke {k}", start, end, radius, radius, "rods", 10))
    return parts


def holed(random: np.random.Generator, pixel: float, variant: int) -> Subject:
    """Fences, baskets, perforated plates and chains."""
    looks = {"frame": draw_look(random, _SCALES), "rods": draw_look(random, (2.5, 6.0))}
    kind = variant % 4
    if kind == 0:
        return _finished(_fence(random, pixel), looks)
    if kind == 1:
        return _finished(_basket(random, pixel), looks)
    if kind == 2:
        cells = random.integers(4, 9, 2)
        cell = 1.5 / cells.max()
        mesh = shapes.perforated(
            int(cells[0]),
            int(cells[1]),
            cell,
            random.uniform(0.5, 0.8) * cell,
            random.uniform(0.03, 0.08),
        )
        turn = about("z", random.uniform(-40, 40))
        foot = box("foot", (-0.5, -0.2, 0), (0.5, 0.2, 0.08), "frame", random.uniform(0, 30))
        low = mesh[0][:, 2].min()
        stands = replace(foot, vertices=foot.vertices + np.array([0, 0, low - 0.07]))
        plate = part("plate", shapes.turned(mesh, turn), "rods", smooth=False)
        return _finished([plate, stands], looks)
    links, radius = int(random.integers(5, 9)), random.uniform(0.11, 0.16)
    thick = random.uniform(0.025, 0.04)
    arc = random.uniform(0.03, 0.09)
    parts = []
    step = 2 * radius - 2.6 * thick + 0.09
    for k in range(links):
        angle = 2 * np.pi * np.arange(64) / 64
        line = radius * np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
        line[:, 0] += 0.045 * np.sign(np.cos(angle)) * (np.abs(np.cos(angle)) > 1e-9)
        link = shapes.tube(line, thick, 14, closed=True)
        link = shapes.turned(link, about("x", 90 * (k % 2) + random.uniform(-12, 12)))
        x = (k - (links - 1) / 2) * step
        parts.append(
            part(
                f"link {k}",
                shapes.turned(link, np.eye(3), (x, 0, arc * x * x)),
                ("frame", "rods")[k % 2],
            )
        )
    return _finished(parts, looks)


def _fence(random: np.random.Generator, pixel: float) -> list[Part]:
    """Return a frame with crossing rods before one another, upright."""
    width, height = random.uniform(0.9, 1.5), random.uniform(0.8, 1.1)
    radius = random.uniform(1.8, 4.0) * pixel * 0.5
    parts = [
        box("top", (-width / 2, -0.03, height - 0.05), (width / 2, 0.03, height), "frame"),
        box("bottom", (-width / 2, -0.031, 0), (width / 2, 0.031, 0.05), "frame"),
        box(
            "left",
            (-width / 2 - 0.03, -0.04, -0.02),
            (-width / 2 + 0.03, 0.04, height + 0.02),
            "frame",
        ),
        box(
            "right",
            (width / 2 - 0.03, -0.041, -0.02),
            (width / 2 + 0.03, 0.041, height + 0.02),
            "frame",
        ),
    ]
    slant = random.uniform(-0.25, 0.25) * height
    columns, rows = int(random.integers(6, 12)), int(random.integers(3, 8))
    for k in range(columns):
        x = width * ((k + 1) / (columns + 1) - 0.5)
        limit = width / 2 - 0.01
        top = float(np.clip(x + slant, -limit, limit))
        parts.append(
            cone(
                f"post {k}",
                (x, radius * 0.6, 0.02),
                (top, radius * 0.6, height - 0.02),
                radius,
                radius,
                "rods",
                11,
            )
        )
    for k in range(rows):
        z = height * (k + 1) / (rows + 1)
        parts.append(
            cone(
                f"rail {k}",
                (-width / 2, -radius * 0.6, z),
                (width / 2, -radius * 0.6, z),
                radius,
                radius,
                "rods",
                10,
            )
        )
    return parts


def _basket(random: np.random.Generator, pixel: float) -> list[Part]:
    """Return rods around a bottom, held together by rings that grow upwards."""
    low, high, height = (
        random.uniform(0.35, 0.5),
        random.uniform(0.5, 0.7),
        random.uniform(0.5, 0.8),
    )
    radius = random.uniform(2.0, 4.0) * pixel * 0.5
    parts = [cone("bottom", (0, 0, 0), (0, 0, 0.05), low, low + 0.01, "frame", 48)]
    count, rows = int(random.integers(14, 26)), int(random.integers(3, 7))
    for k in range(count):
        angle = 2 * np.pi * k / count
        other = angle + random.uniform(-0.02, 0.02)
        start = ((low - 0.02) * np.cos(angle), (low - 0.02) * np.sin(angle), 0.02)
        end = (high * np.cos(other), high * np.sin(other), height)
        parts.append(cone(f"rod {k}", start, end, radius, radius, "rods", 10))
    for k in range(rows):
        share = (k + 1) / rows
        mesh = shapes.ring(low - 0.02 + (high - low + 0.02) * share, 1.5 * radius, 72, 11)
        parts.append(
            part(f"ring {k}", shapes.turned(mesh, np.eye(3), (0, 0, height * share)), "frame")
        )
    return parts


def _vessel(random: np.random.Generator, kind: int) -> Mesh:
    """Return a cup (0), a bowl (1) or a vase (2), open at the top."""
    t = np.linspace(0.0, 1.0, 30)
    wall = random.uniform(0.02, 0.045)
    if kind == 0:
        height, radius = (
            random.uniform(0.9, 1.3),
            np.full(30, 0.48) + random.uniform(-0.05, 0.12) * t,
        )
    elif kind == 1:
        height = random.uniform(0.4, 0.6)
        radius = 0.25 + random.uniform(0.4, 0.55) * np.sqrt(1.001 - (1 - t) ** 2)
    else:
        height = random.uniform(1.2, 1.6)
        wave = np.sin(np.pi * (t * random.uniform(1.1, 1.5) + 0.15))
        radius = 0.34 + random.uniform(0.10, 0.20) * wave
    outer = np.stack([radius, height * t], 1)
    inner = np.stack([radius - wall, height * t], 1)[::-1]
    inner = inner[inner[:, 1] > 1.5 * wall]
    floor = [[inner[-1, 0], 1.5 * wall], [0.0, 1.5 * wall]]
    return shapes.lathe(np.concatenate([[[0.0, 0.0]], outer, inner, floor]))


def vessels(random: np.random.Generator, pixel: float, variant: int) -> Subject:
    """Cups, bowls and vases whose inside is seen."""
    kind = variant % 3
    looks = {"glaze": draw_look(random, _SCALES), "ear": draw_look(random, _SCALES)}
    mesh = _vessel(random, kind)
    parts = [part("vessel", mesh, "glaze")]
    if kind != 1:
        height = float(mesh[0][:, 2].max())
        angle = np.radians(np.linspace(-80, 80, 24))
        reach = random.uniform(0.26, 0.36)
        levels = height * (0.5 + 0.3 * np.sin(angle))
        outer = mesh[0][1:-1].reshape(-1, 72, 3)[:30, 0]
        hull = np.interp(levels, outer[:, 2], outer[:, 0])
        x = hull - 0.012 + reach * (np.cos(angle) - np.cos(angle[0]))
        line = np.stack([x, 0 * x, levels], 1)
        parts.append(part("ear", shapes.tube(line, random.uniform(0.035, 0.06), 16), "ear"))
    return _finished(parts, looks)


def plates(random: np.random.Generator, pixel: float, variant: int) -> Subject:
    """Boxes and plates with sharp edges: piles, houses of cards, stairs, open crates."""
    looks = {f"face{k}": draw_look(random, _SCALES) for k in range(3)}
    kind = variant % 4
    parts: list[Part] = []
    if kind == 0:
        z = 0.0
        for k in range(int(random.integers(4, 7))):
            size = random.uniform([0.4, 0.3, 0.1], [0.9, 0.8, 0.3])
            x, y = random.uniform(-0.12, 0.12, 2)
            low = (x - size[0] / 2, y - size[1] / 2, z - 0.004)
            high = (x + size[0] / 2, y + size[1] / 2, z + size[2])
            parts.append(box(f"box {k}", low, high, f"face{k % 3}", random.uniform(0, 90)))
            z += size[2]
    elif kind == 1:
        parts.append(box("base", (-0.7, -0.5, 0), (0.7, 0.5, 0.05), "face0"))
        for k in range(int(random.integers(4, 7))):
            x, y = random.uniform(-0.5, 0.5), random.uniform(-0.3, 0.3)
            half, thick = random.uniform(0.15, 0.35), random.uniform(0.006, 0.02)
            parts.append(
                box(
                    f"card {k}",
                    (x - half, y - thick, 0.03),
                    (x + half, y + thick, random.uniform(0.4, 0.9)),
                    f"face{1 + k % 2}",
                    random.uniform(0, 180),
                )
            )
    elif kind == 2:
        steps = int(random.integers(4, 7))
        xs, zs = (
            np.linspace(-0.6, 0.6, steps + 1),
            np.linspace(0, random.uniform(0.7, 1.0), steps + 1),
        )
        filled = np.arange(steps)[None] <= np.arange(steps)[:, None]
        mesh = shapes.blocks(xs, np.array([-0.4, 0.4]), zs, filled[:, None, :])
        parts.append(part("stairs", shapes.turned(mesh, about("z", 25)), "face0", smooth=False))
        side = box("side", (-0.62, 0.3, -0.05), (0.63, 0.36, 1.05 * zs[-1]), "face1")
        turn = about("z", 25)
        parts.append(replace(side, vertices=side.vertices @ turn.T))
    else:
        thick = random.uniform(0.03, 0.06)
        w, d, h = random.uniform([0.8, 0.6, 0.4], [1.2, 0.9, 0.8])
        xs = np.array([0, thick, w / 2, w / 2 + thick, w - thick, w])
        ys = np.array([0, thick, d - thick, d])
        zs = np.array([0, thick, h])
        filled = np.ones((5, 3, 2), bool)
        filled[1, 1, 1] = filled[3, 1, 1] = False
        parts.append(part("crate", shapes.blocks(xs, ys, zs, filled), "face0", smooth=False))
        parts.append(
            box(
                "in crate",
                (0.15 * w, 0.3 * d, 0.5 * thick),
                (0.35 * w, 0.6 * d, 1.15 * h),
                "face1",
                20,
            )
        )
    return _finished(parts, looks)


def foliage(random: np.random.Generator, pixel: float, variant: int) -> Subject:
    """Thin two-sided leaves on stems that leave a pot."""
    looks = {
        "leaf0": draw_look(random, (4.0, 8.0)),
        "leaf1": draw_look(random, (4.0, 8.0)),
        "stem": draw_look(random, _SCALES),
        "pot": draw_look(random, _SCALES),
    }
    parts = [cone("pot", (0, 0, -0.45), (0, 0, 0.0), 0.20, 0.28, "pot", 48)]
    t = np.linspace(0.0, 1.0, 14)[:, None]
    thick = random.uniform(0.008, 0.016)
    for s in range(int(random.integers(3, 6))):
        yaw = random.uniform(0, 2 * np.pi)
        out = np.array([np.cos(yaw), np.sin(yaw), 0.0]) * random.uniform(0.2, 0.5)
        start = 0.1 * out / np.linalg.norm(out) - [0, 0, 0.06]
        line = start + t * [0, 0, random.uniform(0.7, 1.1)] + t**2 * out
        parts.append(part(f"stem {s}", shapes.tube(line, random.uniform(0.012, 0.022), 10), "stem"))
        for k in range(int(random.integers(6, 11))):
            at = line[int(random.integers(4, 14))]
            mesh = shapes.leaf(
                random.uniform(0.22, 0.42),
                random.uniform(0.10, 0.2),
                random.uniform(-0.6, 0.1),
                thick,
            )
            turn = about("z", random.uniform(0, 360)) @ about("y", random.uniform(-55, 15))
            parts.append(part(f"leaf {s} {k}", shapes.turned(mesh, turn, at), f"leaf{k % 2}"))
    return _finished(parts, looks)


def gloss(random: np.random.Generator, pixel: float, variant: int) -> Subject:
    """A glazed vessel or blob, a mirror ball and a matte cube, side by side."""
    white = (0.85, 0.86, 0.88)
    looks = {
        "glazed": draw_look(random, _SCALES, finish=GLAZED),
        "mirror": Look("plaster", (white, white, white), 1.0, MIRROR),
        "cube": draw_look(random, _SCALES, finish=MATTE),
    }
    body = _vessel(random, 2) if variant % 2 == 0 else shapes.blob(random, 4, 0.25)
    low, high = body[0].min(0), body[0].max(0)
    size = random.uniform(0.75, 0.95) / (high - low).max()
    vertices = (body[0] - [(low + high)[0] / 2, (low + high)[1] / 2, low[2]]) * size
    ball, ball_faces = icosphere(4)
    radius, side = random.uniform(0.18, 0.26), random.uniform(0.3, 0.42)
    angle = random.uniform(0, 360)
    parts = [
        part("glazed", shapes.turned((vertices, body[1]), about("z", angle)), "glazed"),
        part("mirror", (radius * ball + [0.72, -0.1, radius], ball_faces), "mirror"),
        box(
            "cube",
            (-0.75 - side / 2, -0.2, 0),
            (-0.75 + side / 2, side - 0.2, side),
            "cube",
            random.uniform(0, 90),
        ),
    ]
    return _finished(parts, looks, reflects=True)
