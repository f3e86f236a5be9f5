# SPDX-License-Identifier: GPL-3.0-or-later
"""What a training does when the device fails that it runs on: less of its memory, or none of it."""

from __future__ import annotations

import logging
from collections.abc import Callable

from ..devices.failures import is_device_failure, is_memory_failure
from ..errors import WrapError
from ..report_warning import ReportWarning
from .devices.cpu_backend import CpuBackend
from .iteration import Stepper
from .live_view import LiveView
from .poses.posed_photos import PosedPhotos
from .state import Snapshot, TrainingState

_logger = logging.getLogger(__name__)


class DeviceRecovery:
    """Brings states to the backend that computes, and to another where that fails.

    Parameters
    ----------
    stepper : Stepper
        Its backend is replaced by the processor's where the device is given up.
    photos : PosedPhotos
        Follow the poses of the state in use.
    live : LiveView
        Renders where the stepper computes.
    threads : int
        Of the processor.
    """

    def __init__(self, stepper: Stepper, photos: PosedPhotos, live: LiveView, threads: int) -> None:
        self.stepper, self.photos, self.live, self.threads = stepper, photos, live, threads

    def adopt(self, state: TrainingState) -> None:
        """Bring a state to where the backend computes, and the photos to its poses."""
        backend = self.stepper.backend
        state.adam = backend.adopted(state.adam)
        state.statistics = backend.adopted_statistics(state.statistics)
        self.photos.poses = state.poses

    def begun(self, state: TrainingState) -> Snapshot:
        """Adopt a state and return its snapshot; on the processor where the device fails at it."""
        before = state.adam, state.statistics
        try:
            self.adopt(state)
            return state.snapshot()
        except (WrapError, RuntimeError) as error:
            if not self.is_device_failure(error):
                raise
            name = self.stepper.backend.name
            self._use_processor()
            state.adam, state.statistics = before
            self.adopt(state)
            _note(state, name, error, "on the processor")
            return state.snapshot()

    def is_device_failure(self, error: Exception) -> bool:
        """Tell whether the device that trains failed, so that the training can do without it."""
        return not isinstance(self.stepper.backend, CpuBackend) and is_device_failure(error)

    def without_device(
        self, error: Exception, snapshot: Snapshot, again: Callable[[], TrainingState]
    ) -> TrainingState:
        """Go back to what a failing device has left: with less of its memory, or without it.

        Parameters
        ----------
        error : Exception
            How it failed.
        snapshot : Snapshot
            The last one; a driver that was reset takes it along.
        again : callable
            Returns the state of the last checkpoint, or of a new start.
        """
        backend = self.stepper.backend
        smaller = is_memory_failure(error) and backend.use_less_memory()
        if not smaller:
            self._use_processor()
        try:
            state = TrainingState.of_snapshot(snapshot)
            self.adopt(state)
        except (WrapError, RuntimeError) as lost:
            # The snapshot is lost, or there is no room for its copy.
            if not is_device_failure(lost):
                raise
            smaller = False
            self._use_processor()
            self.photos.poses = None  # as at the first start
            state = again()
            self.adopt(state)
        _note(state, backend.name, error, "with less memory" if smaller else "on the processor")
        return state

    def _use_processor(self) -> None:
        self.stepper.backend = CpuBackend(self.threads)
        self.live.renderer = self.stepper.renderer


def _note(state: TrainingState, device: str, error: Exception, onward: str) -> None:
    _logger.warning(
        "%s failed (%s): going on %s from iteration %d", device, error, onward, state.iteration
    )
    state.warnings.append(
        ReportWarning(
            "device-failed",
            f"{device} failed in the training ({error}); it went on {onward} from iteration "
            f"{state.iteration}.",
            "Close other programs that use the GPU, or choose fewer Gaussians.",
        )
    )
