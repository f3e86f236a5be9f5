# SPDX-License-Identifier: GPL-3.0-or-later
"""Jobs: started, cancelled, resumed, found."""

import contextlib
import logging
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import bpy
from bpy.app.handlers import persistent
from bpy.props import BoolProperty, StringProperty

from ..core.errors import DatasetError, UsageError, WrapError
from ..core.files import real_path
from ..core.jobs.client import JobClient, worker_python
from ..core.jobs.store.job_file import JobFile, make_job
from ..core.jobs.store.job_folder import JobFolder, JobStatus
from ..core.jobs.store.rollback import continue_training_job, finished_job
from ..core.jobs.store.stage_folder import read_done
from ..core.names import AUTOMATIC_REGIONS, region_name, region_names
from ..core.regions.files import read_region_file
from ..core.settings import JobSettings, with_values
from . import addon, job_timer, panel_settings
from .addon import OperatorResult, ReportsErrors, properties_of
from .job_timer import WatchedJob, gone, jobs, key_of
from .panel_settings import (
    computers_choices,
    job_folder_of,
    job_settings,
    meshing_choices,
    output_of,
    source_of,
    texture_choices,
)
from .region_objects import export_region
from .region_operators import own_lengths, world_per_blender
from .worker_setup import WorkerChoice, worker_choice, worker_problem

# -- Conditions and the confirmation shared by operators on jobs ----------------------------------


def why_busy(context: bpy.types.Context) -> str:
    """Return that a job runs in the scene; ``""`` if none does."""
    running = job_timer.is_running(properties_of(context.scene).job_folder)
    return "A job is running; cancel it or wait for it" if running else ""


def why_no_start(context: bpy.types.Context) -> str:
    """Return why no job can start in the scene: no worker, or one is running; ``""`` if it can."""
    return worker_problem() or why_busy(context)


def selected_regions(context: bpy.types.Context) -> list[bpy.types.Object]:
    """Return the selected region objects, the active one first; else the result's only region."""
    active = context.view_layer.objects.active
    things = [t for t in context.selected_objects if addon.kind_of(t) == "region"]
    frame = None if things else addon.current_frame(context)
    if frame is not None:
        own = [t for t in frame.children if addon.kind_of(t) == "region"]
        things = own if len(own) == 1 else []
    return sorted(things, key=lambda t: (t != active, t.name))


def checked_regions(context: bpy.types.Context) -> list[bpy.types.Object]:
    """Return the checked regions of the scene by name."""
    things = addon.objects_of_kind(context.scene, "region")
    return sorted((t for t in things if properties_of(t).checked), key=lambda t: t.name)


class ConfirmsFolder(ReportsErrors):
    """Mixin: confirm a job folder known from the open file alone, which may come from elsewhere."""

    def frame(self, context: bpy.types.Context) -> bpy.types.Object | None:
        """Return the frame of the result that the operator would use."""
        return addon.current_frame(context)

    def folder(self, context: bpy.types.Context) -> Path | None:
        """Return the job folder that the operator would use."""
        frame = self.frame(context)
        return addon.result_folder(frame).parent if frame and frame.get(addon.RESULT) else None

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> OperatorResult:
        """Ask for confirmation if the folder is unknown on this machine."""
        folder = self.folder(context)
        if folder is None or addon.is_trusted(folder):
            return self.execute(context)
        return context.window_manager.invoke_confirm(
            self,
            event,
            title="Use This Job Folder?",
            message=f"The file names a job folder not yet used on this computer: {folder}",
            confirm_text="Use Folder",
        )


class OnRegions(ConfirmsFolder):
    """Mixin: the operator works on regions of one result."""

    def regions(self, context: bpy.types.Context) -> list[bpy.types.Object]:
        """Return these regions."""
        return selected_regions(context)

    def frame(self, context: bpy.types.Context) -> bpy.types.Object | None:
        return addon.frame_of(next(iter(self.regions(context)), None))


# -- Find the jobs named by the open file, and keep scenes and jobs connected across undo ---------


_logger = logging.getLogger(__name__)


def find_job_folder(stored: str) -> Path | None:
    """Return the job folder named by the open file, or None if there is none.

    A folder that has moved together with the .blend file is found beside it.
    """
    if not stored:
        return None
    folder = Path(bpy.path.abspath(stored))
    candidates = [folder]
    if bpy.data.filepath:
        candidates.append(Path(bpy.data.filepath).parent / folder.name)
    for candidate in candidates:
        if addon.is_trusted(candidate) and candidate.is_dir():
            return candidate
    return None


def attach(scene: bpy.types.Scene, folder: Path) -> JobStatus:
    """Watch the job of a folder; a running one is imported when done.

    Raises UsageError: the folder contains no job.
    """
    client = JobClient.attach(folder)
    status = client.poll()
    job_timer.show(scene, folder, WatchedJob(client, status, scene.session_uid, status.active))
    if status.active:
        job_timer.start_timer()
    return status


def attach_open_file() -> None:
    """Find the jobs of the open file again; only reads their status."""
    for known in jobs.values():
        known.scene_uid = 0
    for scene in bpy.data.scenes:
        stored = properties_of(scene).job_folder
        job = jobs.get(key_of(stored))
        if job is not None:
            job.scene_uid = scene.session_uid
            if job.imports:  # finished while another file was open
                job.waits_for_mode = not job.status.active
                job_timer.start_timer()
            continue
        folder = find_job_folder(stored)
        if folder is None:
            place = Path(key_of(stored))
            # Folders known from the file alone are not touched: they may be on any network.
            if stored and addon.is_trusted(place) and not place.is_dir():
                gone.add(str(place))
            continue
        try:
            attach(scene, folder)
        except (WrapError, OSError) as error:
            _logger.info("job of scene %s: %s", scene.name, error)


def attach_later() -> bool:
    """Attach at one tick of the timer: until then, scripts cannot access the open file."""
    attach_open_file()
    return False


@persistent
def after_load(_arguments: object = None, _unused: object = None) -> None:
    """``load_post``: find the jobs of the file that was opened."""
    with contextlib.suppress(AttributeError):  # the add-on is being removed
        attach_open_file()


@persistent
def after_undo(_scene: object = None, _unused: object = None) -> None:
    """``undo_post``, ``redo_post``: a scene keeps its job; starting one is no undo step."""
    newest = {job.scene_uid: folder for folder, job in jobs.items() if job.scene_uid}
    for uid, folder in newest.items():
        scene = addon.scene_of_uid(uid)
        if scene is not None and key_of(properties_of(scene).job_folder) != folder:
            properties_of(scene).job_folder = folder
            properties_of(scene).job_command = jobs[folder].command


# -- Actions of the job buttons as plain functions: from properties to a running worker -----------


def launch(
    scene: bpy.types.Scene,
    folder: Path,
    job: JobFile,
    choice: WorkerChoice,
    command: str = "WRAP",
    target_uid: int = 0,
) -> None:
    """Start a job and show it in a scene, as one that its button has started (``command``).

    ``target_uid``: session uid of the object that photos are baked onto. Raises WrapError: there
    is no worker, or the folder cannot be used.
    """
    client = JobClient.start(
        folder, job, python=worker_python(choice.python), keep_running=choice.keep_running
    )
    properties_of(scene).job_command = command
    job_timer.watch(scene, folder, client, target_uid=target_uid)


def start_wrap(scene: bpy.types.Scene, choice: WorkerChoice) -> Path:
    """Start the whole pipeline for a scene's photos; return the job folder.

    Raises WrapError: the source, the output or a setting cannot be used.
    """
    source = source_of(scene)
    folder = output_of(scene, source)
    job = make_job("wrap", source, job_settings(scene, choice.threads, choice.device))
    refuse_running(folder)
    launch(scene, folder, job, choice)
    properties_of(scene).output = str(folder)
    return folder


def start_mesh(
    scene: bpy.types.Scene, regions: list[bpy.types.Object], choice: WorkerChoice
) -> None:
    """Mesh regions of a finished training, each at its resolution.

    Raises WrapError: a region cannot be used, or the job folder contains no finished training.
    """
    folder = job_folder_of(common_frame(regions))
    if not any(read_done(path) for path in (folder / "stages").glob("train-*")):
        raise UsageError(
            f"{folder} holds no finished training.", "Wrap the scene again, or find its folder."
        )
    refuse_running(folder)
    earlier = finished_job(JobFolder(folder))
    changed = {"threads": choice.threads, "device": choice.device, **computers_choices(scene)}
    settings = with_values(earlier.settings, changed)
    start_on_regions(scene, regions, choice, "mesh", earlier.source, settings)


CAMERA_SETTINGS: Final = (
    "seed", "turntable", "equirectangular", "mask_invert", "mask_grow_px", "georeference",
    "markers", "control_points", "video_frames", "video_fps",
)  # fmt: skip
"""What a job's cameras depend on besides its input."""


def start_wrap_for(
    scene: bpy.types.Scene,
    regions: list[bpy.types.Object],
    choice: WorkerChoice,
    changed: Mapping[str, Any],
) -> None:
    """Train a finished job's photos anew for regions, with ``changed`` settings, and mesh these.

    Cameras are re-used; so are masks that were made of the same regions.

    Raises WrapError: a region or a setting cannot be used, or the job folder holds no job.
    """
    folder = job_folder_of(common_frame(regions))
    refuse_running(folder)
    earlier = finished_job(JobFolder(folder))
    # The region lies in the world of the job's cameras, which would move with any of these.
    same = {name: getattr(earlier.settings, name) for name in CAMERA_SETTINGS}
    settings = job_settings(scene, choice.threads, choice.device)
    settings = with_values(settings, {**same, **changed})
    start_on_regions(scene, regions, choice, "wrap", earlier.source, settings)


def start_on_regions(
    scene: bpy.types.Scene,
    regions: list[bpy.types.Object],
    choice: WorkerChoice,
    command: str,
    source: str,
    settings: JobSettings,
) -> None:
    """Start a job in the folder of a result that meshes regions.

    Of ``settings``, those of the regions, of meshing and texture are taken from the scene.
    """
    frame = common_frame(regions)
    folder = job_folder_of(frame)
    own = own_lengths(scene, regions, frame)
    requests = export_requests(regions, frame, folder)
    chosen = meshing_choices(scene, world_per_blender(frame)) | texture_choices(scene)
    settings = with_values(settings, {"regions": tuple(requests), **chosen})
    lengths = {r: length for r, length in zip(requests, own, strict=True) if length is not None}
    job = make_job(command, Path(source), settings, lengths)
    names = region_names(job.settings.regions, job.region_bodies)
    launch(scene, folder, job, choice, command.upper())
    for region, name in zip(regions, names, strict=True):
        region[addon.REGION] = name  # the import finds this box and adds no second one


def start_more(scene: bpy.types.Scene, frame: bpy.types.Object, choice: WorkerChoice) -> None:
    """Train a finished job further, then mesh and texture it again.

    Raises WrapError: the job folder contains no finished training, or too many iterations are
    requested.
    """
    folder = job_folder_of(frame)
    refuse_running(folder)
    known, count = JobFolder(folder), properties_of(scene).training.more_iterations
    job = continue_training_job(known, finished_job(known), count)
    changed = {"threads": choice.threads, "device": choice.device, **computers_choices(scene)}
    launch(scene, folder, replace(job, settings=with_values(job.settings, changed)), choice)


def resume(scene: bpy.types.Scene, choice: WorkerChoice) -> Path:
    """Continue a scene's job; finished stages are re-used. Return the job folder."""
    if not properties_of(scene).job_folder:
        raise UsageError("This scene has no job.", "Wrap the scene first.")
    folder = Path(bpy.path.abspath(properties_of(scene).job_folder))
    refuse_running(folder)
    client = JobClient.resume(
        folder, python=worker_python(choice.python), keep_running=choice.keep_running,
        device=choice.device,
    )  # fmt: skip
    job_timer.watch(scene, folder, client)
    return folder


def export_requests(
    regions: list[bpy.types.Object], frame: bpy.types.Object, folder: Path
) -> list[str]:
    """Write the files of regions into their job's folder; return their paths.

    Raises WrapError: a region is linked from a library, or has no body.
    """
    for region in regions:
        if not region.is_editable:
            raise UsageError(
                f"Region {region.name} is linked from a library.",
                "Make it local (Object > Relations > Make Local).",
            )
    requests = []
    for region in regions:
        path = folder / "regions" / f"{region.session_uid}.json"
        path.parent.mkdir(exist_ok=True)
        export_region(region, path, _result_name(region, frame))
        requests.append(str(path))
    return requests


def _result_name(region: bpy.types.Object, frame: bpy.types.Object) -> str:
    """Return the name under which a region's new mesh replaces its earlier one.

    A renamed region keeps it. Its copies, which have the same tag, do not: of several regions, it
    belongs to the one that still has this name, or else to none. Nor does the automatic region
    have it, once the user meshes its box.
    """
    name = region.get(addon.REGION, "")
    if not isinstance(name, str) or name in ("", *AUTOMATIC_REGIONS):
        return ""
    things = [t for t in bpy.data.objects if addon.kind_of(t) == "region"]
    same = [t for t in things if t.get(addon.REGION) == name and addon.frame_of(t) == frame]
    if len(same) == 1 or region_name(region.name, {"blender_object_name": region.name}) == name:
        return _stored_name(frame, name)
    return ""


def _stored_name(frame: bpy.types.Object, folder: str) -> str:
    """Return the name of the region whose result is in a folder; the folder's name is a safe form.

    Under another name it would be another region, whose result may not be replaced.
    """
    try:
        stored = read_region_file(addon.result_folder(frame) / folder / "region.json").name
    except DatasetError:
        return folder
    return stored if region_name(stored, {"blender_object_name": stored}) == folder else folder


def refuse_running(folder: Path) -> None:
    """Raise :class:`UsageError` where a job runs in a folder."""
    if job_timer.is_running(str(folder)):
        raise UsageError(f"A job is running in {folder}.", "Cancel it or wait for it.")


def common_frame(regions: list[bpy.types.Object]) -> bpy.types.Object:
    """Return the common frame of regions.

    Raises UsageError: there is none, or there are several.
    """
    if not regions:
        raise UsageError("No region is selected.", "Select a region box.")
    frames = {addon.frame_of(region) for region in regions}
    frame = next(iter(frames))
    if len(frames) > 1:
        raise UsageError("The regions belong to different results.", "Select those of one result.")
    if frame is None:
        raise UsageError(
            f"{regions[0].name} belongs to no result.", "Add a region after wrapping the scene."
        )
    return frame


# -- Operators that start, stop, find and resume jobs; none changes data of the open file ---------


class GWRAP_OT_wrap_scene(ReportsErrors, bpy.types.Operator):
    bl_idname = "gwrap.wrap_scene"
    bl_label = "Wrap Scene"
    bl_description = "Make a textured mesh of the photos in a background process"

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        if not properties_of(context.scene).source:
            return "Choose the folder of the photos first"
        if panel_settings.has_errors(context.scene):
            return (
                "The photos cannot be used as they are: see Dataset, then press Check Photos again"
            )
        return why_no_start(context)

    def work(self, context: bpy.types.Context) -> None:
        folder = start_wrap(context.scene, worker_choice(context))
        self.report({"INFO"}, f"Wrapping in {folder}")


class GWRAP_OT_mesh_region(OnRegions, bpy.types.Operator):
    bl_idname = "gwrap.mesh_region"
    bl_label = "Mesh Region"
    bl_description = (
        "Mesh the selected or the checked regions from the finished training, without training "
        "again"
    )

    checked: BoolProperty(options={"HIDDEN", "SKIP_SAVE"})  # type: ignore[valid-type]

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        if addon.current_frame(context) is None:
            return "Needs a finished training: press Wrap Scene first"
        if not selected_regions(context) and not checked_regions(context):
            return "Select or check a region in the list, or press Add Region Box"
        return why_no_start(context)

    def regions(self, context: bpy.types.Context) -> list[bpy.types.Object]:
        # Without a selection, the checked regions are meant.
        return (not self.checked and selected_regions(context)) or checked_regions(context)

    def work(self, context: bpy.types.Context) -> None:
        regions = self.regions(context)
        start_mesh(context.scene, regions, worker_choice(context))
        self.report({"INFO"}, f"Meshing {', '.join(r.name for r in regions)}")


class GWRAP_OT_train_for_regions(OnRegions, bpy.types.Operator):
    bl_idname = "gwrap.train_for_regions"
    bl_label = "Train for Regions"
    bl_description = (
        "Train again, most of all for what stands in the checked regions, and mesh these; cameras "
        "are kept, masks made of a region are not used"
    )

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        if not checked_regions(context):
            return "Check a region in the list"
        return why_no_start(context)

    def regions(self, context: bpy.types.Context) -> list[bpy.types.Object]:
        return checked_regions(context)

    def work(self, context: bpy.types.Context) -> None:
        regions = self.regions(context)
        earlier = finished_job(JobFolder(job_folder_of(common_frame(regions))))
        if earlier.source.lower().endswith(".ply") or earlier.settings.start_splat:
            raise UsageError(
                "This result was made of a splat: there is no training that could be for regions.",
                "Mesh the region instead.",
            )
        start_wrap_for(context.scene, regions, worker_choice(context), {"make_masks": "off"})
        self.report({"INFO"}, f"Training for {', '.join(r.name for r in regions)}")


class GWRAP_OT_cancel_job(ReportsErrors, bpy.types.Operator):
    bl_idname = "gwrap.cancel_job"
    bl_label = "Cancel"
    bl_description = "Stop the job; it can be resumed from where it stopped"

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        return "" if why_busy(context) else "No job is running; Wrap Scene starts one"

    def work(self, context: bpy.types.Context) -> None:
        job_timer.cancel(properties_of(context.scene).job_folder)


class OnSceneJob(ConfirmsFolder):
    """Mixin: the operator works on the scene's own job."""

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        stored = properties_of(context.scene).job_folder
        return "" if stored else "This scene has no job; press Wrap Scene, or find its folder"

    def folder(self, context: bpy.types.Context) -> Path:
        return Path(bpy.path.abspath(properties_of(context.scene).job_folder))


class GWRAP_OT_resume_job(OnSceneJob, bpy.types.Operator):
    bl_idname = "gwrap.resume_job"
    bl_label = "Resume"
    bl_description = "Continue the job from its last checkpoint; finished stages are reused"

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        if job_timer.is_gone(properties_of(context.scene).job_folder):
            return "The job folder is missing; press Find Job if it was moved"
        return super().why_not(context) or why_busy(context)

    def work(self, context: bpy.types.Context) -> None:
        resume(context.scene, worker_choice(context))


class GWRAP_OT_find_job(ReportsErrors, bpy.types.Operator):
    bl_idname = "gwrap.find_job"
    bl_label = "Find Job"
    bl_description = "Choose the folder of a job that was started earlier or has been moved"

    directory: StringProperty(name="Job Folder", subtype="DIR_PATH", options={"SKIP_SAVE"})  # type: ignore[valid-type]
    filter_folder: bpy.props.BoolProperty(default=True, options={"HIDDEN"})  # type: ignore[valid-type]

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> OperatorResult:
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def work(self, context: bpy.types.Context) -> None:
        if not self.directory:
            raise UsageError("No folder was chosen.", "Choose the folder of a job.")
        folder = real_path(bpy.path.abspath(self.directory))
        status = attach(context.scene, folder)
        addon.remember(folder)
        self.report({"INFO"}, f"Found a job: {status.state.lower()}")


CLASSES: Final = (
    GWRAP_OT_wrap_scene, GWRAP_OT_mesh_region, GWRAP_OT_train_for_regions, GWRAP_OT_cancel_job,
    GWRAP_OT_resume_job, GWRAP_OT_find_job,
)  # fmt: skip
