# SPDX-License-Identifier: GPL-3.0-or-later
"""What operators share: the add-on, redrawing, texts, errors, tags of objects, known jobs."""

from __future__ import annotations

import contextlib
import json
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

import bpy

from ..core.errors import UsageError, WrapError
from ..core.files import read_json, real_path, write_json
from ..core.scene.camera import Similarity

# -- Name, preferences and properties of the add-on in Blender ------------------------------------


def addon_package() -> str:
    """Return the name under which Blender has enabled the add-on."""
    return __package__.rpartition(".ops")[0]


def addon_preferences(context: bpy.types.Context) -> Any:
    """Return the preferences, or ``None`` where the package is not enabled as an add-on."""
    addon = context.preferences.addons.get(addon_package())
    return addon.preferences if addon is not None else None


def properties_of(owner: bpy.types.Scene | bpy.types.Object) -> Any:
    """Return the add-on's properties of a scene or region (``ui/properties.py``)."""
    return owner.gwrap  # type: ignore[union-attr]


# -- Redraw areas of Blender's windows, and show that Blender is busy -----------------------------


def _areas(*kinds: str) -> Iterator[bpy.types.Area]:
    areas = (area for w in bpy.context.window_manager.windows for area in w.screen.areas)
    return (area for area in areas if area.type in kinds)


def redraw(*kinds: str) -> None:
    """Tag all areas of these types for redrawing; by default 3D views."""
    for area in _areas(*(kinds or ("VIEW_3D",))):
        area.tag_redraw()


def redraw_sidebars() -> None:
    """Let the side panels of 3D views be drawn again, but not the views."""
    for region in (region for area in _areas("VIEW_3D") for region in area.regions):
        if region.type == "UI":
            region.tag_redraw()


def redraw_status_bars() -> None:
    """Let the status bars of all windows be drawn again; they are in no screen's areas.

    They listen to the name of the view layer, which nothing here changes.
    """
    if not bpy.app.background:
        bpy.msgbus.publish_rna(key=(bpy.types.ViewLayer, "name"))


@contextmanager
def waiting(context: bpy.types.Context) -> Iterator[None]:
    """Show the wait cursor while Blender is blocked."""
    window = None if bpy.app.background else context.window
    if window is not None:
        window.cursor_modal_set("WAIT")
    try:
        yield
    finally:
        if window is not None:
            window.cursor_modal_restore()


# -- Texts of the panels in the language of Blender's interface (``ui/translations``) -------------


CONTEXT: Final = "GaussianWrapping"
"""Of our texts: Blender has other meanings for some, such as *Paper*, *Fine* and *Open*."""


def tr(text: str, **values: object) -> str:
    """Return a text of the panel in the interface's language, with its ``{values}`` filled in.

    A text without translation, such as an error of the worker, stays as it is.
    """
    translated = bpy.app.translations.pgettext_iface(text, CONTEXT)
    return translated.format(**values) if values else translated


# -- Custom properties that tag the add-on's objects; they survive undo, renaming and saving ------


KIND = "gwrap_kind"
"""``"frame"`` (the parent empty), ``"mesh"``, ``"lod"``, ``"camera"``, ``"region"``,
``"point"`` or ``"baked"``."""
WITH_TEXTURE = ("mesh", "lod", "baked")
"""Kinds of meshes with our material: of regions, coarser levels, lighter meshes of a bake."""
RESULT = "gwrap_result"
"""On the frame: the result folder; ``//`` means beside the .blend file."""
FINGERPRINT = "gwrap_fingerprint"
WORLD_FROM_SCENE = "gwrap_world_from_scene"
"""On the frame: the similarity as JSON text, in float64, which object matrices are not."""
PLACEMENT = "gwrap_blender_from_scene"
"""On the frame: the similarity of its matrix as JSON text, in float64, once it has been placed."""
FIGURES = "gwrap_figures"
"""On the frame: figures of the report as JSON text (``result_files.py``)."""
REGION = "gwrap_region"
"""On meshes and regions: the name of the region in the result folder."""
LEVEL = "gwrap_level"
"""On levels of detail: 1, 2, ..."""
STAMP = "gwrap_stamp"
"""On meshes and levels of detail: changes when the mesh file changes."""
BAKE = "gwrap_bake"
"""On any mesh object that photos are baked onto: the folder of the bake below ``baked``."""
BAKE_NOTE = "gwrap_bake_note"
"""On the same: what the last bake says of itself, for the panel."""
PHOTO = "gwrap_photo"
RESOLUTION = "gwrap_resolution_px"
PIXEL_ASPECT = "gwrap_pixel_aspect"
DISPLAY_SCALE = "gwrap_display_scale"
"""On photo cameras: the scale of the scene that clipping and frustum size are for."""


def kind_of(thing: bpy.types.Object | None) -> str:
    """Return the tag of an object, or ``""``."""
    value = thing.get(KIND, "") if thing is not None else ""
    return value if isinstance(value, str) else ""


def objects_of_kind(scene: bpy.types.Scene, kind: str) -> Iterator[bpy.types.Object]:
    """Yield the objects of a scene that have a tag."""
    return (thing for thing in scene.objects if kind_of(thing) == kind)


def scene_of_uid(uid: int) -> bpy.types.Scene | None:
    """Return the scene of a session uid in the open file."""
    return next((s for s in bpy.data.scenes if s.session_uid == uid), None)


def frame_of(thing: bpy.types.Object | None) -> bpy.types.Object | None:
    """Return the parent empty of a result's object (or the object itself), or None."""
    while thing is not None:
        if kind_of(thing) == "frame":
            return thing
        thing = thing.parent
    return None


def current_frame(context: bpy.types.Context) -> bpy.types.Object | None:
    """Return the frame of the active object, or else the scene's newest one, or None."""
    frames = list(objects_of_kind(context.scene, "frame"))
    return frame_of(context.view_layer.objects.active) or (frames[-1] if frames else None)


def needed_frame(context: bpy.types.Context) -> bpy.types.Object:
    """Return :func:`current_frame`. Raises UsageError: there is none."""
    frame = current_frame(context)
    if frame is None:
        raise UsageError("The scene has no result.", "Wrap the scene or import a result.")
    return frame


def result_folder(frame: bpy.types.Object) -> Path:
    """Return the result folder that a frame names. Raises UsageError: the frame has none."""
    text = frame.get(RESULT, "")
    if not isinstance(text, str) or not text:
        raise UsageError(f"{frame.name} has no result folder.", "Import the result again.")
    return Path(bpy.path.abspath(text))


def world_from_scene(frame: bpy.types.Object) -> Similarity:
    """Return the similarity from the scene frame to the world of the input.

    Raises UsageError: the custom property is missing or was edited.
    """
    try:
        return Similarity.from_json(json.loads(frame[WORLD_FROM_SCENE]))
    except (KeyError, TypeError, ValueError, RecursionError):
        raise UsageError(
            f"{frame.name} has lost its world coordinates.", "Import the result again."
        ) from None


def figures_of(frame: bpy.types.Object | None) -> str:
    """Return the figures of the report as JSON text; ``""`` where there are none."""
    value = frame.get(FIGURES, "") if frame is not None else ""
    return value if isinstance(value, str) else ""


# -- Mixins of operators: typed errors become one report with its next step -----------------------


OperatorResult = set[Literal["RUNNING_MODAL", "CANCELLED", "FINISHED", "PASS_THROUGH", "INTERFACE"]]
"""Return type of ``execute``, ``invoke`` and ``modal``."""

if TYPE_CHECKING:
    _Operator = bpy.types.Operator
else:
    _Operator = object

_logger = logging.getLogger(__name__)


class ReportsErrors(_Operator):
    """Mixin: ``poll`` asks ``why_not``; ``execute`` calls ``work`` and reports what it raises."""

    @classmethod
    def why_not(cls, _context: bpy.types.Context) -> str:
        """Return why the operator cannot run now, and the next step; ``""`` if it can."""
        return ""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Tell whether the operator can run; Blender calls this."""
        reason = cls.why_not(context)
        cls.poll_message_set(reason)
        return not reason

    def work(self, context: bpy.types.Context) -> None:
        """Perform the operation."""
        raise NotImplementedError

    def execute(self, context: bpy.types.Context) -> OperatorResult:
        """Run :meth:`work`; Blender calls this."""
        try:
            self.work(context)
            return {"FINISHED"}
        except WrapError as error:
            _logger.info("%s: %s", type(self).__name__, error)
            self.report({"ERROR"}, str(error))
        except OSError as error:
            _logger.exception("%s", type(self).__name__)
            self.report({"ERROR"}, f"{error.strerror}: {error.filename}")
        return {"CANCELLED"}


class NeedsObjectMode(ReportsErrors):
    """Mixin: the operator is available in Object Mode only."""

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        return "" if context.mode == "OBJECT" else "Change to Object Mode first"


class NeedsResult(ReportsErrors):
    """Mixin: the operator acts on the scene's current result."""

    @classmethod
    def why_not(cls, context: bpy.types.Context) -> str:
        if current_frame(context) is None:
            return "The scene has no result; wrap it, or import one"
        return super().why_not(context)


# -- Job folders used on this machine, so that a .blend from elsewhere opens none -----------------
#
# A .blend file names its job folder. It may come from the internet, and the folder beside it with
# it: the folder is read without confirmation only if it was used on this machine before.


MAX_KNOWN = 200
_FILE = "known_jobs.json"
_session: list[str] = []


def remember(folder: Path) -> None:
    """Record a folder that the user has chosen."""
    text = str(real_path(folder))
    if text in _session:
        return
    _session.append(text)
    path = _list_path()
    if path is not None:
        known = [t for t in _stored() if t != text]
        try:
            write_json(path, [*known, text][-MAX_KNOWN:])
        except OSError:
            _logger.exception("cannot write %s", path)


def is_trusted(folder: Path) -> bool:
    """Return whether a folder named by the open file may be read without confirmation."""
    if is_remote(folder):
        return False
    absolute = str(real_path(folder))
    return absolute in _session or absolute in _stored()


def is_named(folder: Path) -> bool:
    """Return whether a folder was used on this machine, by its name alone.

    The folder is not touched: it may be on a network that does not answer. Links are not followed.
    """
    return not is_remote(folder) and (str(folder) in _session or str(folder) in _stored())


def is_remote(folder: Path) -> bool:
    r"""Return whether a path is ``\\server\share``: Windows would send it the user's name."""
    return str(folder).replace("\\", "/").startswith("//")


def _list_path() -> Path | None:
    with contextlib.suppress(ValueError, OSError):  # ValueError: not installed as an extension
        return Path(bpy.utils.extension_path_user(addon_package(), create=True)) / _FILE
    return None


def _stored() -> list[str]:
    path = _list_path()
    if path is None or not path.is_file():
        return []
    try:
        values = read_json(path, follow_links=True)
    except (OSError, WrapError):
        return []
    return [v for v in values if isinstance(v, str)] if isinstance(values, list) else []
