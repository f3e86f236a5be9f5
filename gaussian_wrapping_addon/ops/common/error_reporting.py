# SPDX-License-Identifier: GPL-3.0-or-later
"""Mixins of operators: typed errors become one report with its next step."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Literal

import bpy

from ...core.errors import WrapError
from . import tags

OperatorResult = set[Literal["RUNNING_MODAL", "CANCELLED", "FINISHED", "PASS_THROUGH", "INTERFACE"]]
"""Return type of ``execute``, ``invoke`` and ``modal``."""

if TYPE_CHECKING:
    _Operator = bpy.types.Operator
else:
    _Operator = object

_logger = logging.getLogger(__name__)


class ReportsErrors(_Operator):
    """Mixin: ``execute`` calls ``work`` and reports what it raises."""

    def work(self, context: bpy.types.Context) -> OperatorResult:
        """Perform the operation."""
        raise NotImplementedError

    def execute(self, context: bpy.types.Context) -> OperatorResult:
        """Run :meth:`work`; Blender calls this."""
        try:
            return self.work(context)
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
    def poll(cls, context: bpy.types.Context) -> bool:
        """Tell whether the operator can run; Blender calls this."""
        if context.mode != "OBJECT":
            cls.poll_message_set("Change to Object Mode first")
            return False
        return True


class NeedsResult(_Operator):
    """Mixin: the operator acts on the scene's current result."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Tell whether the operator can run; Blender calls this."""
        if tags.current_frame(context.scene, context.view_layer.objects.active) is None:
            cls.poll_message_set("The scene has no result; wrap it, or import one")
            return False
        return True
