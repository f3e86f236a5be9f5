# SPDX-License-Identifier: GPL-3.0-or-later
"""Runs inside a real Blender with a window: photos to a textured region, with the real worker.

``blender ... -P drive_session.py``; ``GW_GUI_FOLDER`` holds ``photos/`` (the example photos) and
takes screenshots and ``outcome.json``; ``GW_GUI_WORKER`` is the worker's Python.
"""

from __future__ import annotations

import gc
import os
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Vector

sys.path.insert(0, str(Path(__file__).parent))
import driving
from driving import check, objects, press, screenshot, until

JOB_DEADLINE_S = 1200.0


class Stalls:
    """Measures how long the add-on's timer keeps Blender waiting while a job runs."""

    def __init__(self) -> None:
        self._timer = driving.module("ops.job_timer")
        self._poll = self._timer.poll_jobs
        self._timer.poll_jobs = self._measured
        self.looks_s: list[float] = []
        """Without waiting for a processor that others had."""
        self.imports_s: list[float] = []
        self.longest: list[dict[str, Any]] = []
        """The longest looks, each with what the job did and where the time went."""
        self._parts_s: dict[str, float] = {}
        for owner, name in (
            (driving.module("core.jobs.client").JobClient, "poll"),
            (driving.module("ops.job_timer"), "refresh"),
            (self._timer, "_bring_in"),
            (self._timer, "redraw"),
        ):
            setattr(owner, name, self._timed(name, getattr(owner, name)))
        gc.callbacks.append(self._collecting)
        self._collection_began_s = 0.0

    def _timed(self, name: str, call: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*arguments: Any, **options: Any) -> Any:
            began_s = time.perf_counter()
            try:
                return call(*arguments, **options)
            finally:
                self._add(name, time.perf_counter() - began_s)

        return timed

    def _collecting(self, phase: str, _information: dict[str, int]) -> None:
        if phase == "start":
            self._collection_began_s = time.perf_counter()
        else:
            self._add("collecting garbage", time.perf_counter() - self._collection_began_s)

    def _add(self, name: str, took_s: float) -> None:
        self._parts_s[name] = self._parts_s.get(name, 0.0) + took_s

    def _measured(self, *arguments: Any) -> bool:
        things = len(bpy.data.objects)
        self._parts_s.clear()
        # The outer clocks may count what happens between them and the inner one, never less.
        waited_s, stolen, spent_s = queued_s(), stolen_s(), time.thread_time()
        began_s = time.perf_counter()
        answer = self._poll(*arguments)
        took_s = time.perf_counter() - began_s
        spent_s = time.thread_time() - spent_s
        waited_s, stolen = queued_s() - waited_s, stolen_s() - stolen
        if len(bpy.data.objects) != things:
            self.imports_s.append(took_s)
            return answer
        look = {
            "look_s": max(0.0, took_s - waited_s - stolen),
            "took_s": took_s,
            "processor_s": spent_s,
            "waited_for_a_processor_s": waited_s,
            "stolen_s": stolen,
            "parts_s": dict(self._parts_s),
            "stage": driving.job_status().stage,
        }
        self.looks_s.append(look["look_s"])
        by_length = sorted([*self.longest, look], key=lambda look: -float(look["took_s"]))
        self.longest = by_length[:8]
        return answer

    def summary(self) -> dict[str, Any]:
        """Return the figures for ``outcome.json``."""
        return {
            "looks": len(self.looks_s),
            "longest_look_s": max(self.looks_s),
            "median_look_s": statistics.median(self.looks_s),
            "imports_s": self.imports_s,
            "longest": self.longest,
        }


def queued_s() -> float:
    """Return how long this thread has waited for a processor that others had, as Linux tells."""
    return int(Path("/proc/thread-self/schedstat").read_text().split()[1]) * 1e-9


def stolen_s() -> float:
    """Return how long the machine's host had its processors for others, in hundredths."""
    return int(Path("/proc/stat").read_text().split(maxsplit=9)[8]) / os.sysconf("SC_CLK_TCK")


def photos() -> Iterator[float]:
    """Choose the photos and let them be checked."""
    scene = bpy.context.scene
    scene.gwrap.source = str(driving.FOLDER / "photos")
    press(bpy.ops.gwrap.check_photos)
    yield from until(lambda: len(scene.gwrap.findings) > 0, "the photos are checked", 120.0)
    check(all(f.severity != "error" for f in scene.gwrap.findings), "the photos can be used")
    yield 0.5
    screenshot("1-checked")


def wrap() -> Iterator[float]:
    """Press Wrap Scene, watch the bar move, see the textured object."""
    bpy.context.scene.gwrap.preset = "DRAFT"
    stalls = Stalls()
    press(bpy.ops.gwrap.wrap_scene)
    yield from until(lambda: driving.state_of_job() == "RUNNING", "the job runs")
    seen: list[float] = []
    stages: list[str] = []
    photographed = False
    end_s = time.monotonic() + JOB_DEADLINE_S
    while driving.state_of_job() == "RUNNING":
        if time.monotonic() > end_s:
            check(False, "the job ends in time")
        status = driving.job_status()
        if not seen or status.fraction != seen[-1]:
            seen.append(status.fraction)
        if not stages or status.stage != stages[-1]:
            stages.append(status.stage)
        pictures = driving.module("ops.job_timer").icons_of(bpy.context.scene.gwrap.job_folder)
        if status.stage == "train" and pictures and not photographed:
            yield 1.0
            screenshot("2-training")
            photographed = True
        yield 0.2
    check(photographed, "a preview was shown while it trained")
    check(driving.state_of_job() == "DONE", f"the job is done: {driving.job_status()}")
    check(len(seen) > 10, f"the bar moved: {len(seen)} steps")
    check(seen == sorted(seen), "the bar never went back")
    check({"cameras", "train", "mesh", "texture"} <= set(stages), f"stages: {stages}")
    yield from until(lambda: objects("mesh") != [], "the result is imported")
    driving.outcome["stalls"] = stalls.summary()
    driving.frame_view(objects("mesh"))
    yield 1.0
    screenshot("3-wrapped")
    textured(objects("mesh")[0])


def textured(thing: bpy.types.Object) -> None:
    """A mesh with UVs and an image that holds a picture."""
    mesh = thing.data
    check(len(mesh.polygons) > 1000, f"{thing.name} has {len(mesh.polygons)} faces")
    check(len(mesh.uv_layers) == 1, f"{thing.name} has UVs")
    faces_of_edge = np.zeros(len(mesh.edges), dtype=np.int64)
    edges = np.empty(len(mesh.loops), dtype=np.int32)
    mesh.loops.foreach_get("edge_index", edges)
    np.add.at(faces_of_edge, edges, 1)
    check(bool((faces_of_edge == 2).all()), f"{thing.name} is closed")
    nodes = thing.active_material.node_tree.nodes
    images = [n.image for n in nodes if n.type == "TEX_IMAGE"]
    check(images != [] and images[0].has_data, f"{thing.name} has a texture")
    pixels = np.empty(len(images[0].pixels), dtype=np.float32)
    images[0].pixels.foreach_get(pixels)
    check(float(pixels.reshape(-1, 4)[:, :3].std()) > 0.05, "the texture is a picture")


def region() -> Iterator[float]:
    """Draw a box around a part, mesh it finer, see it beside the first."""
    first = objects("mesh")[0]
    corners = np.array([first.matrix_world @ Vector(c) for c in first.bound_box])
    low, high = corners.min(axis=0), corners.max(axis=0)
    bpy.context.scene.cursor.location = (low + high) / 2
    press(bpy.ops.gwrap.add_region_box, around="CURSOR")
    box = bpy.context.view_layer.objects.active
    check(box.get("gwrap_kind") == "region", "a region box is added")
    box.name = "Close Look"
    size = float((high - low).max())
    box.scale = [float(v) / 4 / box.empty_display_size for v in high - low]
    box.location = box.location + Vector((0.05 * size, 0.0, 0.0))
    properties = bpy.context.scene.gwrap
    properties.resolution = "EDGE_LENGTH"
    properties.edge_length = size / 150
    yield 0.5
    screenshot("4-region")
    press(bpy.ops.gwrap.mesh_region)
    yield from until(
        lambda: len(objects("mesh")) == 2 or driving.state_of_job() == "FAILED",
        "the region is meshed", JOB_DEADLINE_S,
    )  # fmt: skip
    check(driving.state_of_job() == "DONE", f"the region's job: {driving.job_status()}")
    second = next(o for o in objects("mesh") if o.name != first.name)
    textured(second)
    limits = box.matrix_world @ Vector((0, 0, 0))
    inside = np.array([box.matrix_world.inverted() @ (second.matrix_world @ v.co)
                       for v in second.data.vertices])  # fmt: skip
    check(bool((np.abs(inside) <= box.empty_display_size * 1.001).all()),
          f"it lies inside the box around {tuple(limits)}")  # fmt: skip
    check(first.parent == second.parent, "both stand under one parent")
    first.hide_set(True)
    driving.frame_view([second])
    yield 1.0
    screenshot("5-region-meshed")
    first.hide_set(False)


def steps() -> Iterator[float]:
    """The session, from the empty file to the saved one."""
    preferences = bpy.context.preferences.addons[driving.NAME].preferences
    preferences.worker_python = os.environ["GW_GUI_WORKER"]
    yield from driving.open_tab()
    yield from photos()
    yield from wrap()
    yield from region()
    bpy.ops.wm.save_as_mainfile(filepath=str(driving.FOLDER / "session.blend"))
    yield 0.5


driving.run(steps())
