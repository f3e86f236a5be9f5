# SPDX-License-Identifier: GPL-3.0-or-later
"""All that lives across iterations: state, checkpoint, result, cancellation."""

from __future__ import annotations

import dataclasses
import hashlib
import io
import logging
import math
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch

from ..array_file import read_arrays
from ..errors import ParseError, UsageError
from ..files import open_regular, read_json, write_bytes, write_json
from ..gaussians.model import TRAINED, OrientedGaussians
from ..progress import Progress, ReportWarning, read_warnings
from ..scene.camera import Camera
from ..scene.scene import PhotoSource, Scene
from ..settings import TrainingSettings, key_values
from .adam import Adam
from .camera_poses import CameraPoses
from .density import DensityStatistics
from .exposure import Exposure
from .model_selection import ModelSelection

# -- Cancellation inside the loops of a training that render many views per iteration -------------

Item = TypeVar("Item")


def cancellable(items: Iterable[Item], progress: Progress) -> Iterator[Item]:
    """Yield the items, checking for cancellation before each one is made.

    A wrapping round renders all training views, which takes longer than the two seconds within
    which a cancelled job stops. A loop that changes the training state only after its last view
    leaves the state unchanged when it ends early.

    Raises
    ------
    Cancelled
        Before the next item, once cancellation was requested.
    """
    iterator = iter(items)
    while True:
        progress.check()
        try:
            item = next(iterator)
        except StopIteration:
            return
        yield item


class CancellablePhotos:
    """Photo source that checks for cancellation on every access.

    For loops over all photos before the first iteration or after the last.
    """

    def __init__(self, photos: PhotoSource, progress: Progress) -> None:
        self._photos, self._progress = photos, progress

    def camera(self, index: int, divisor: int = 1) -> Camera:
        return self._photos.camera(index, divisor)

    def photo(self, index: int, divisor: int = 1) -> np.ndarray:
        self._progress.check()
        return self._photos.photo(index, divisor)

    def mask(self, index: int, divisor: int = 1) -> np.ndarray | None:
        self._progress.check()
        return self._photos.mask(index, divisor)


# -- Training state: everything that the next iteration depends on --------------------------------

_MOMENTS = ("first", "second")
_STATISTICS = ("gradient", "gradient_abs", "views")
_NUMBERS = {
    "iteration": int, "rate_factor": float, "restarts": int, "error_average": float,
    "loss_average": float, "seconds": float, "degree": int,
}  # fmt: skip


@dataclass(frozen=True)
class Snapshot:
    """A copy of a state to go back to, of which the large part stays where the training runs."""

    adam: Adam
    arrays: dict[str, np.ndarray]
    values: dict[str, Any]


@dataclass
class TrainingState:
    """Parameters, moments, statistics, random generator and view order of a run."""

    adam: Adam
    statistics: DensityStatistics
    random: np.random.Generator
    iteration: int = 0
    """Number of finished iterations."""
    order: list[int] = field(default_factory=list)
    """Views still to come in this epoch, last first."""
    rate_factor: float = 1.0
    """Factor of the learning rates, lowered after a restart from non-finite values."""
    restarts: int = 0
    error_average: float = 0.0
    """Moving average of the mean squared colour error, for the progress message."""
    loss_average: float = 0.0
    degree: int = 0
    """Degree of the harmonics in use."""
    model_selection: ModelSelection = field(default_factory=ModelSelection)
    """Decisions so far; stored under the key ``needs``."""
    exposure: Exposure | None = None
    """Per-photo exposures; ``None`` where they are not modelled."""
    poses: CameraPoses | None = None
    """Refined poses of the cameras; ``None`` where they stay as given."""
    warnings: list[ReportWarning] = field(default_factory=list)
    history: list[dict[str, float]] = field(default_factory=list)
    seconds: float = 0.0
    """Training time up to the last checkpoint."""

    @classmethod
    def start(cls, gaussians: OrientedGaussians, seed: int) -> TrainingState:
        """Return the state before the first iteration."""
        random = np.random.Generator(np.random.PCG64([seed, 2]))
        return cls(Adam(gaussians), DensityStatistics.zeros(len(gaussians)), random)

    def next_view(self, views: list[int]) -> int:
        """Draw the next view: all views in random order, epoch by epoch.

        See docs/method.md, section 1.4.
        """
        if not self.order:
            self.order = self.random.permutation(views).tolist()
        return self.order.pop()

    def clear_statistics(self) -> None:
        """Reset the statistics, as after a change in the number of Gaussians."""
        self.statistics = self.statistics.cleared(len(self.adam))

    def snapshot(self) -> Snapshot:
        """Return a copy of everything that the next iteration depends on."""
        return Snapshot(self.adam.copy(), self._other_arrays(), self.to_json())

    @classmethod
    def of_snapshot(cls, snapshot: Snapshot) -> TrainingState:
        """Return the state of a snapshot, which can be used again."""
        return cls._of(snapshot.adam.copy(), snapshot.arrays, snapshot.values)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return copies of all arrays, by name."""
        adam, arrays = self.adam.on_host(), {}
        for name in adam.values:
            arrays[f"value.{name}"] = adam.array(name).copy()
        for name in TRAINED:
            for kind, moment in zip(_MOMENTS, adam.moments(name), strict=True):
                arrays[f"{kind}.{name}"] = moment.copy()
        arrays["steps"] = adam.steps.copy()
        return arrays | self._other_arrays()

    def _other_arrays(self) -> dict[str, np.ndarray]:
        """Return copies of the arrays that are not the optimiser's."""
        arrays = {}
        for name in _STATISTICS:
            arrays[f"statistics.{name}"] = getattr(self.statistics, name).copy()
        if self.exposure is not None:
            arrays |= {f"exposure.{k}": v for k, v in self.exposure.to_arrays().items()}
        if self.poses is not None:
            arrays |= {f"poses.{k}": v for k, v in self.poses.to_arrays().items()}
        return arrays

    def to_json(self) -> dict[str, Any]:
        """Return the rest of the state as plain JSON values."""
        values: dict[str, Any] = {
            **{name: getattr(self, name) for name in _NUMBERS},
            "random": self.random.bit_generator.state,
            "order": list(self.order),
            "history": [dict(entry) for entry in self.history],
            "needs": self.model_selection.to_json(),
            "warnings": [warning.to_json() for warning in self.warnings],
        }
        if self.adam.frozen:
            values["frozen"] = self.adam.frozen
        return values

    @classmethod
    def restore(cls, arrays: dict[str, np.ndarray], values: dict[str, Any]) -> TrainingState:
        """Build from :meth:`to_arrays` and :meth:`to_json`; the arrays are copied.

        Raises
        ------
        KeyError, ValueError, TypeError
            An entry is missing, or entries are inconsistent.
        """
        tensors = {
            name.removeprefix("value."): torch.from_numpy(array.copy())
            for name, array in arrays.items()
            if name.startswith("value.")
        }
        count = len(arrays["steps"])
        adam = Adam(OrientedGaussians(**tensors))
        for name in adam.values:
            _require(adam.array(name), arrays[f"value.{name}"], count)
        for name in TRAINED:
            for kind, moment in zip(_MOMENTS, adam.moments(name), strict=True):
                moment[...] = _require(moment, arrays[f"{kind}.{name}"], count)
        adam.steps = _require(adam.steps, arrays["steps"], count).copy()
        return cls._of(adam, arrays, values)

    @classmethod
    def _of(
        cls, adam: Adam, arrays: dict[str, np.ndarray], values: dict[str, Any]
    ) -> TrainingState:
        """Return the state of an optimiser, other arrays, which are copied, and JSON values."""
        count = len(adam)
        adam.frozen = int(values.get("frozen", 0))
        if not 0 <= adam.frozen <= count:
            raise ValueError(f"{adam.frozen} of {count} Gaussians are frozen")
        statistics = DensityStatistics.zeros(count)
        for name in _STATISTICS:
            old = getattr(statistics, name)
            setattr(statistics, name, _require(old, arrays[f"statistics.{name}"], count).copy())
        generator = np.random.PCG64()
        generator.state = values["random"]
        state = cls(adam, statistics, np.random.Generator(generator))
        for name, kind in _NUMBERS.items():
            setattr(state, name, kind(values[name]))
        state.order = [int(i) for i in values["order"]]
        state.history = [{k: float(v) for k, v in entry.items()} for entry in values["history"]]
        state.model_selection = ModelSelection.from_json(values["needs"])
        state.warnings = list(read_warnings(values["warnings"]))
        exposure = _part(arrays, "exposure.")
        state.exposure = Exposure.restore(exposure) if exposure else None
        poses = _part(arrays, "poses.")
        state.poses = CameraPoses.restore(poses) if poses else None
        return state


def _part(arrays: dict[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    """Return the arrays whose names have a prefix, with the prefix removed."""
    return {k.removeprefix(prefix): v for k, v in arrays.items() if k.startswith(prefix)}


def _require(like: np.ndarray, array: np.ndarray, count: int) -> np.ndarray:
    if array.shape != like.shape or array.dtype != like.dtype or len(array) != count:
        raise ValueError(f"an array is {array.dtype} {array.shape}, not {like.dtype} {like.shape}")
    return array


# -- Training checkpoints: arrays in an npz; the rest, and its hash, in a JSON file written last

_logger = logging.getLogger(__name__)

VERSION = 2
KEPT = 2
"""Number of checkpoints kept; the older one is the fallback for a broken newest one."""

_NAME = re.compile(r"checkpoint-(\d{1,9})\.json")
_AGAIN = "Delete the folder and train again."
_BLOCK_BYTES = 1024 * 1024


def fingerprint(
    scene: Scene,
    settings: TrainingSettings,
    seed: int,
    start: Path | None = None,
    taken_over: str = "",
) -> str:
    """Hash the inputs that a training's result depends on.

    These are settings, seed, cameras, photo names and points.

    Parameters
    ----------
    start : Path, optional
        File of Gaussians that the training starts from; its content is hashed.
    taken_over : str
        Digest of what it takes over from another training.
    """
    described = key_values(settings)
    described.pop("extra_iterations")  # a longer run starts as the shorter one does
    digest = hashlib.sha256()
    digest.update(repr((VERSION, sorted(described.items()), seed)).encode())
    for view in scene.views:
        camera = view.camera
        numbers = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
        digest.update(repr((camera.name, view.photo_path.name, numbers)).encode())
        digest.update(np.ascontiguousarray(camera.cam_from_world, np.float64).tobytes())
    digest.update(np.ascontiguousarray(scene.points, np.float64).tobytes())
    if start is not None:
        with open(start, "rb") as file:
            digest.update(hashlib.file_digest(file, "sha256").digest())
    digest.update(taken_over.encode())
    return digest.hexdigest()


def save_checkpoint(folder: Path, state: TrainingState, key: str) -> Path:
    """Write the state atomically and remove all but the last two checkpoints.

    Returns
    -------
    Path
        The JSON file. The npz is ignored without it, or if its hash differs.
    """
    stream = io.BytesIO()
    np.savez(stream, **state.to_arrays())
    data = stream.getvalue()
    path = folder / f"checkpoint-{state.iteration:09d}.json"
    write_bytes(path.with_suffix(".npz"), data)
    checksum = hashlib.sha256(data).hexdigest()
    values = {"version": VERSION, "fingerprint": key, "sha256": checksum, "state": state.to_json()}
    write_json(path, values)
    remove_checkpoints(folder, KEPT)
    return path


def load_checkpoint(folder: Path, key: str) -> TrainingState | None:
    """Return the newest readable state of a folder, or ``None`` without a checkpoint.

    A broken checkpoint is logged and the one before it is tried.

    Raises
    ------
    UsageError
        The checkpoint belongs to other photos, settings or seed.
    ParseError
        There are checkpoints, but none can be read.
    """
    failure: ParseError | None = None
    for path in _listed(folder):
        try:
            return _load(path, key)
        except ParseError as error:
            _logger.warning("%s", error)
            failure = failure or error
    if failure is not None:
        raise failure
    return None


def remove_checkpoints(folder: Path, kept: int = 0) -> None:
    """Delete the checkpoints of a finished run, or all but the newest ones."""
    for path in _listed(folder)[kept:]:
        path.unlink(missing_ok=True)
        path.with_suffix(".npz").unlink(missing_ok=True)


def _listed(folder: Path) -> list[Path]:
    """Return the JSON files, newest first."""
    found = [p for p in folder.glob("checkpoint-*.json") if _NAME.fullmatch(p.name)]
    return sorted(found, key=lambda path: path.name, reverse=True)


def _load(path: Path, key: str) -> TrainingState:
    values = read_json(path)
    if not isinstance(values, dict) or values.get("version") != VERSION:
        raise ParseError(path, "version", f"version {VERSION} was expected.", _AGAIN)
    if values.get("fingerprint") != key:
        raise UsageError(
            f"{path.name} was written with other photos, settings or another seed.",
            "Train in a new folder, or use the inputs of the first run.",
        )
    arrays = _read_arrays(path.with_suffix(".npz"), values.get("sha256"))
    try:
        state = TrainingState.restore(arrays, values["state"])
        if not state.adam.is_finite():
            raise ValueError("a parameter is not finite")
        return state
    except (KeyError, ValueError, TypeError, AttributeError) as error:
        raise ParseError(path, "state", f"is inconsistent ({error}).", _AGAIN) from None


def _read_arrays(path: Path, sha256: Any) -> dict[str, np.ndarray]:
    digest = hashlib.sha256()
    try:
        with open_regular(path) as stream:
            while block := stream.read(_BLOCK_BYTES):
                digest.update(block)
    except OSError as error:
        raise ParseError(path, "whole file", f"cannot be read ({error}).", _AGAIN) from None
    if digest.hexdigest() != sha256:
        raise ParseError(path, "whole file", "truncated or changed.", _AGAIN)
    return read_arrays(path, hint=_AGAIN)


# -- Result of a training: Gaussians, history, held-out metrics, model selection ------------------


@dataclass(frozen=True)
class HeldOutMetrics:
    """Image metrics of one held-out photo."""

    name: str
    psnr: float
    """dB, at the finest training size."""
    ssim: float
    lpips: float | None = None
    """``None`` if not measured."""
    region_psnr: float | None = None
    """dB, of the pixels that look through the regions; ``None`` without any."""

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values; what is not measured is left out."""
        values = dataclasses.asdict(self)
        return {name: value for name, value in values.items() if value is not None}


@dataclass(frozen=True)
class TrainingResult:
    """Trained Gaussians and their metrics."""

    gaussians: OrientedGaussians
    iterations: int
    history: tuple[dict[str, float], ...]
    """Loss, PSNR of the training photos and number of Gaussians over the iterations."""
    held_out: tuple[HeldOutMetrics, ...]
    seconds: float
    warnings: tuple[ReportWarning, ...]
    lpips_note: str = ""
    """Reason why the held-out photos have no LPIPS."""
    model_selection: ModelSelection = field(default_factory=ModelSelection)
    """Decisions on the model (the report's key ``decisions``)."""
    exposure_fitted: bool = False
    """Whether held-out photos were measured after an exposure fitted crosswise on their halves."""
    poses: np.ndarray | None = None
    """(views, 3, 4) refined ``cam_from_world`` of all views, or ``None`` where those given hold."""
    device: str = "cpu"
    """Where the last iterations ran: not the device asked for if that failed."""

    @property
    def held_out_psnr(self) -> float:
        """Mean PSNR of the held-out photos, dB; NaN without any."""
        return _mean([figure.psnr for figure in self.held_out])

    @property
    def region_psnr(self) -> float:
        """Mean PSNR of the regions in the held-out photos that show them, dB; NaN without any."""
        return _mean([f.region_psnr for f in self.held_out if f.region_psnr is not None])

    @property
    def held_out_ssim(self) -> float:
        """Mean SSIM of the held-out photos; NaN without any."""
        return _mean([figure.ssim for figure in self.held_out])

    @property
    def held_out_lpips(self) -> float:
        """Mean LPIPS of the held-out photos that have one; NaN without any."""
        return _mean([figure.lpips for figure in self.held_out if figure.lpips is not None])

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values for the report; of the Gaussians only their number."""
        values: dict[str, Any] = {
            "gaussians": len(self.gaussians),
            "iterations": self.iterations,
            "seconds_training": round(self.seconds, 3),
            "held_out": [figure.to_json() for figure in self.held_out],
            "history": [dict(entry) for entry in self.history],
            "warnings": [warning.to_json() for warning in self.warnings],
            "decisions": self.model_selection.to_json(),
            "held_out_exposure_fitted": self.exposure_fitted,
            "sh_degree": self.gaussians.sh_degree,
        }
        if self.held_out:
            values["held_out_psnr"] = self.held_out_psnr
            values["held_out_ssim"] = self.held_out_ssim
            if not math.isnan(self.region_psnr):
                values["held_out_region_psnr"] = self.region_psnr
            if not math.isnan(self.held_out_lpips):
                values["held_out_lpips"] = self.held_out_lpips
            elif self.lpips_note:
                values["lpips_note"] = self.lpips_note
        return values


def _mean(values: list[float]) -> float:
    return sum(values) / len(values) if values else math.nan
