# SPDX-License-Identifier: GPL-3.0-or-later
"""Graphs of parts as they are planned, and job folders that have them."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from gaussian_wrapping_addon.core.jobs.store.job_file import make_job, write_job
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder
from gaussian_wrapping_addon.core.settings import JobSettings, with_values

PART = {
    "outputs": [], "share": 0.01, "region": "", "tile": -1, "memory_bytes": 1_500_000_000,
    "seconds": 60.0, "block": -1,
}  # fmt: skip


def part(name: str, kind: str, needs: Iterable[str] = ()) -> dict[str, Any]:
    return {"name": name, "kind": kind, "needs": list(needs), **PART}


def region_parts(region: str, tiles: int) -> list[dict[str, Any]]:
    """Return the parts of a region, in one piece where there are no tiles."""
    plan, mesh = f"plan-{region}", f"mesh-{region}"
    if not tiles:
        faces = [plan]
        inner: list[dict[str, Any]] = []
    else:
        points = [f"points-{region}-{k:04d}" for k in range(tiles)]
        faces = [f"faces-{region}-{k:04d}" for k in range(tiles)]
        inner = [part(name, "points", [plan]) for name in points]
        inner.append(part(f"gather-{region}", "gather", points))
        inner += [part(name, "faces", [f"gather-{region}"]) for name in faces]
    return [
        part(plan, "plan", ["train"]),
        *inner,
        part(mesh, "mesh", faces),
        part(f"texture-{region}", "texture", [mesh]),
    ]


def graph(regions: dict[str, int], blocks: int = 0) -> dict[str, Any]:
    """Return ``parts.json`` of a whole job: tiles of each region, 0 for one piece; so of blocks."""
    parts, before = [part("cameras", "cameras")], ["cameras"]
    if blocks:
        parts.append(part("coarse", "coarse", before))
        trained = [part(f"block-{k:04d}", "block", ["coarse"]) for k in range(blocks)]
        parts += trained
        before = [one["name"] for one in trained]
    parts.append(part("train", "train", before))
    for region, tiles in regions.items():
        parts += region_parts(region, tiles)
    parts.append(part("export", "export", [f"texture-{region}" for region in regions]))
    return {
        "version": 1,
        "code": "0.2.0-0123456789ab",
        "plan": "ba9876543210",
        "source": "../photos",
        "parts": parts,
    }


GRAPHS = {
    "one piece": graph({"auto": 0}),
    "tiles": graph({"engine": 8}),
    "blocks": graph({"auto": 2}, 3),
    "several regions": graph({"engine": 3, "Wheel_2": 0, "door": 2}),
    "a bake": {
        **graph({}),
        "parts": [part("cameras", "cameras"), part("bake", "bake", ["cameras"])],
    },
}


def job_folder(root: Path, values: Any = None, tiles: str = "8") -> JobFolder:
    """Make a job folder with the parts of a graph."""
    photos = root.parent / "photos"
    photos.mkdir(parents=True, exist_ok=True)
    folder = JobFolder(root)
    folder.create()
    settings = with_values(JobSettings(), {"meshing.tiles": tiles})
    write_job(folder.job_path, make_job("wrap", photos, settings))
    if values is not None:
        (root / "parts.json").write_text(json.dumps(values))
    return folder


def write_state(root: Path, name: str, state: str, **more: Any) -> None:
    """Write the state of a part, as the process that runs it does."""
    (root / "parts").mkdir(exist_ok=True)
    values = {
        "state": state, "plan": "ba9876543210", "place": "host boot", "pid": 1, "pid_started": 1,
        "token": "1", "begun_s": 1.0, "heartbeat_s": 1000.0, "fraction": 0.5, "message": "",
        "attempts": 1, "error": "", "hint": "", "exit_code": None, "seconds": 1.0,
        "peak_memory_bytes": 1, "figures": {}, "outputs": [],
    }  # fmt: skip
    (root / "parts" / f"{name}.json").write_text(json.dumps(values | more | {"state": state}))
