# SPDX-License-Identifier: GPL-3.0-or-later
"""States of the panel, each set up by a function, and what a drawn panel shows."""

from __future__ import annotations

import time
from pathlib import Path

import bpy
import numpy as np

from gaussian_wrapping_addon import registration
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobStatus
from gaussian_wrapping_addon.ops import dataset, job_timer
from gaussian_wrapping_addon.ops import training as training_estimate
from gaussian_wrapping_addon.ops.panel_settings import choices_key
from gaussian_wrapping_addon.ops.scene_objects import import_result
from gaussian_wrapping_addon.ops.training import Estimate
from tests.blender.fake_layout import FakeLayout, draw
from tests.blender.fake_worker import LIVE
from tests.blender.synthetic_result import png_bytes, write_result

PANELS = [cls for cls in registration.CLASSES if issubclass(cls, bpy.types.Panel)]

OPERATORS = [cls for cls in registration.CLASSES if issubclass(cls, bpy.types.Operator)]

ORDER = [
    "Dataset",
    "Train",
    "Computers",
    "Region",
    "Mesh",
    "Texture",
    "Bake",
    "Result",
    "Scene Tools",
]

ANSWER = Estimate(
    (
        "3 photos, long side 320 px, camera poses still to be solved",
        "Training (standard, 2 threads): 4 to 12 min",
        "Memory: 1.2 GB",
        "Not timed here: the first job compiles the renderer",
    ),
    ("The disk is nearly full.",),
)

ERROR = "The photos share nothing."
HINT = "Take more photos with overlap."


class Client:
    """Answers with one status."""

    def __init__(self, status: JobStatus) -> None:
        self.status = status

    def poll(self) -> JobStatus:
        return self.status


def choose_photos(folder: Path, count: int = 3) -> None:
    photos = folder / "photos"
    photos.mkdir(exist_ok=True)
    for index in range(count):
        pixels = np.full((240, 320, 3), index, np.uint8)
        (photos / f"{index}.png").write_bytes(png_bytes(pixels))
    bpy.context.scene.gwrap.source = str(photos)


def job(folder: Path, state: str, command: str = "WRAP", **more: object) -> None:
    bpy.context.scene.gwrap.job_command = command
    status = JobStatus(state, "train", 0.25, "step", 90.0, **more)  # type: ignore[arg-type]
    client = Client(status)
    job_timer.watch(bpy.context.scene, folder / "job", client, imports=False)  # type: ignore[arg-type]


def no_data(_folder: Path) -> None:
    """As a new file is."""


def not_checked(folder: Path) -> None:
    choose_photos(folder)


def checking(folder: Path) -> None:
    choose_photos(folder)
    dataset._checks.submit(lambda: time.sleep(1.0), lambda _: None)


def checked(folder: Path) -> None:
    choose_photos(folder)
    bpy.ops.gwrap.check_photos()


def bad_data(folder: Path) -> None:
    choose_photos(folder, 1)
    bpy.ops.gwrap.check_photos()


def estimated(folder: Path) -> None:
    checked(folder)
    training_estimate._keep(choices_key(bpy.context.scene), ANSWER)


def training(folder: Path) -> None:
    checked(folder)
    job(folder, "RUNNING", figures=LIVE)


def cancelling(folder: Path) -> None:
    checked(folder)
    job(folder, "CANCELLING")


def failed(folder: Path) -> None:
    checked(folder)
    job(folder, "FAILED", error=ERROR, hint=HINT)


def lost(folder: Path) -> None:
    checked(folder)
    job(folder, "LOST", error=ERROR, hint=HINT)


def cancelled(folder: Path) -> None:
    checked(folder)
    job(folder, "CANCELLED", hint="Resume continues from the last checkpoint.")


def not_open(folder: Path) -> None:
    checked(folder)
    bpy.context.scene.gwrap.job_folder = str(folder / "job")


def gone(folder: Path) -> None:
    not_open(folder)
    job_timer.gone.add(str(folder / "job"))


def to_import(folder: Path) -> None:
    checked(folder)
    job(folder, "DONE", result=str(write_result(folder / "job")))


def in_edit_mode(folder: Path) -> None:
    to_import(folder)
    bpy.ops.mesh.primitive_cube_add()
    bpy.ops.object.mode_set(mode="EDIT")
    job_timer.jobs[str(folder / "job")].waits_for_mode = True


def done(folder: Path) -> None:
    to_import(folder)
    import_result(folder / "job" / "result", bpy.context.scene)
    bpy.context.view_layer.update()


def done_two_regions(folder: Path) -> None:
    done(folder)
    bpy.ops.gwrap.add_region_box()
    for thing in bpy.context.selected_objects:
        thing.select_set(False)


def meshing(folder: Path) -> None:
    done(folder)
    job(folder, "RUNNING", "MESH")


def mesh_failed(folder: Path) -> None:
    done(folder)
    result = str(folder / "job" / "result")
    job(folder, "DONE", "MESH", result=result, error=ERROR, hint=HINT, put_back=True)


def tab() -> dict[str, FakeLayout]:
    """Draw what a person sees: panels with ``Parent / Child`` as their names."""
    labels = {cls.__name__: cls.bl_label for cls in PANELS}
    found = {}
    for cls in PANELS:
        if not getattr(cls, "poll", lambda _context: True)(bpy.context):
            continue
        parent = labels.get(getattr(cls, "bl_parent_id", ""), "")
        found[f"{parent} / {cls.bl_label}" if parent else cls.bl_label] = draw(cls)
    return found


def can_run(operator: str) -> bool:
    module, name = operator.split(".")
    return bool(getattr(getattr(bpy.ops, module), name).poll())


def buttons(layout: FakeLayout) -> list[str]:
    """Return the buttons: ``*`` before the large one, ``-`` before greyed ones."""
    return [
        ("*" if b.large else "")
        + ("" if b.enabled and can_run(b.operator) else "-")
        + b.operator.removeprefix("gwrap.")
        for b in layout.buttons
    ]


def words(layout: FakeLayout) -> str:
    return " ".join(layout.texts.split())
