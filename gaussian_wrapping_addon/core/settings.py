# SPDX-License-Identifier: GPL-3.0-or-later
"""Every setting of a job, as frozen dataclasses shared by panel, command line and worker."""

from __future__ import annotations

import dataclasses
import math
import typing
from dataclasses import dataclass, field
from typing import Any

from .errors import SettingError, UsageError
from .export_formats import JOB_FORMATS
from .limits import MAX_ATLASES, MAX_TILES

PRESETS = ("draft", "standard", "fine")
DECISIONS = ("auto", "on", "off")
"""Of what a scene may need: ``"auto"`` lets the photos decide (design.md 6)."""
SWITCH = ("off", "on")

MASK_MODES = ("ignore", "background")
CORRELATIONS = ("signed", "squared")
SPACINGS = ("adaptive", "uniform")
MESH_METHODS = ("pam", "pivots")
PIVOT_COUNTS = (2, 3, 9)
BOUNDARIES = ("closed", "open")
UNSEEN = ("empty", "occupied")
MAX_LODS = 8
TEXTURE_SOURCES = ("photos", "gaussians")

RESULT_FREE = ("checkpoint_every_s", "preview_every_s")
"""Training settings that the result does not depend on."""

_CHOICES = {
    "harmonics": DECISIONS,
    "exposure": DECISIONS,
    "multi_view": DECISIONS,
    "wrapping": DECISIONS,
    "growth": DECISIONS,
    "full_size": DECISIONS,
    "mask_mode": MASK_MODES,
    "correlation": CORRELATIONS,
}


@dataclass(frozen=True)
class TrainingSettings:
    """How the Gaussians are trained. Iteration milestones are fractions of ``iterations``."""

    iterations: int = 3000
    extra_iterations: int = 0
    """More iterations after the plan's end, at its last learning rates ("train more")."""
    max_gaussians: int = 80_000
    max_image_px: int = 640
    """Long side of the finest training image, pixels."""
    pixels_per_iteration: int = 80_000
    """An iteration looks at a window of the photo with about so many pixels at most."""
    sh_degree: int = 2
    """Highest degree of the harmonics; how much of it is used, ``harmonics`` decides."""
    holdout_every: int = 8
    """Every n-th photo (sorted by name) is kept for measuring only; 0 keeps none."""
    lambda_dssim: float = 0.2
    lambda_depth_normal: float = 0.05
    lambda_normal: float = 0.03
    lambda_photometric: float = 0.15
    """A quarter of the method's: with its 0.6, runs of a tenth of its iterations lose detail."""
    lambda_geometric: float = 0.02
    correlation: str = "signed"
    """Of two patches: ``"signed"``, or ``"squared"``, where -1 is as good as 1 (method.md 3.4)."""
    multi_view_until: float = 0.75
    """The multi-view terms end here: what noise in the photos has pulled about can settle."""
    multi_view_pixels: int = 4000
    """Pixels of an iteration that the multi-view terms look at."""
    multi_view_every: int = 1
    """They are asked in every n-th iteration, with n times the weight."""
    harmonics: str = "auto"
    """``"auto"``: only degrees that lower the error of held-out photos; ``"on"``: all of them;
    ``"off"``: degree 0."""
    exposure: str = "auto"
    """Gain and offset per photo."""
    multi_view: str = "auto"
    """The multi-view terms."""
    wrapping: str = "auto"
    """Orientation, its loss, and clones of opposite orientation."""
    growth: str = "auto"
    """``"auto"``: the number of Gaussians stops growing where it gains little, and those that show
    little are held small (``overlap_price``) and removed (``prune_share``); ``"on"``: only the cap
    stops it; ``"off"``: none are added."""
    full_size: str = "auto"
    """``"auto"``: photos that show nothing finer than half their size are trained on at that size;
    ``"on"``: always at full size; ``"off"``: at half."""
    region_weight: float = 1.0
    """Gaussians inside the job's regions count this many times where their number is limited."""
    focus: str = ""
    """JSON list of the bodies of these regions, world coordinates; written when a job is made that
    trains. Other regions are meshed from the same training later."""
    mask_mode: str = "ignore"
    """What masks leave out: ``"ignore"``: anything may stand there; ``"background"``: nothing."""
    depth_from: float = 7 / 30
    """Depth-normal loss and multi-view terms start here (method.md 3)."""
    densify_from: float = 0.5 / 30
    densify_until: float = 0.5
    densify_every: int = 100
    overlap_price: float = 2e-5
    """Price, in the unit of the loss, of one more Gaussian over every pixel."""
    prune_share: float = 0.005
    """Gaussians that together contribute less than this share of all blending weights are removed
    every now and then; 0 removes none."""
    orient_from: float = 20 / 30
    wrap_rounds: int = 3
    wrap_from: float = 22 / 30
    wrap_until: float = 26 / 30
    wrap_share: float = 0.05
    checkpoint_every_s: float = 60.0
    preview_every_s: float = 20.0
    """Between two preview pictures of a running training; 0 writes none."""


@dataclass(frozen=True)
class MeshingSettings:
    """How a region is meshed. Exactly one of ``edge_length`` and ``points`` decides; 0 = unset."""

    edge_length: float = 0.0
    """Target edge length in world units of the input. With adaptive spacing the mesh comes as close
    to the surface as a uniform one with such edges, with about half as many vertices."""
    points: int = 0
    """Target number of surface points."""
    spacing: str = "adaptive"
    """``"adaptive"``: vertices where the shape needs them, no denser than the photos resolve;
    ``"uniform"``: the same edge length everywhere."""
    tiles: str = "auto"
    """Parts that the region is meshed in, so that memory stays bounded: a number; ``"auto"``: as
    many as the request needs; ``"off"``: the whole at once."""
    method: str = "pam"
    """``"pam"``: primal adaptive meshing; ``"pivots"``: marching tetrahedra on pivots, as fine as
    the Gaussians lie: edge length, number of points do not apply."""
    pivots: int = 2
    """Pivots of each Gaussian where they make the mesh (method.md 6.1)."""
    boundary: str = "closed"
    """Where the region cuts the solid: ``"closed"`` by faces on the region's planes; ``"open"``
    leaves those out."""
    unseen: str = "empty"
    """What stands where no camera looks: nothing (``"empty"``), or something (``"occupied"``)."""
    min_component_share: float = 0.01
    """Parts smaller than this share of the largest by area, and shorter than three times this share
    of the longest, are removed and counted."""
    target_faces: int = 0
    """The mesh is decimated to this number of faces; 0 leaves all."""
    smooth_steps: int = 0
    """Steps of a filter that keeps the volume; 0 smooths nothing."""


@dataclass(frozen=True)
class TextureSettings:
    """How the mesh is unwrapped and textured."""

    size_px: int = 0
    """Side of the square texture; 0 chooses it from the photos' footprint."""
    gutter_px: int = 8
    """Texels around each chart of a texture of 4096; in proportion below, but 2 at least."""
    normal_map: str = "auto"
    """Whether the detail of the dense mesh is baked: ``"auto"`` where faces were taken away,
    ``"on"`` always (flat where none were), or ``"off"``."""
    ambient_occlusion: str = "off"
    """``"on"`` bakes how open the dense mesh is to its surroundings."""
    lods: int = 0
    """Levels of detail below the mesh itself, each with a quarter of the faces."""
    source: str = "photos"
    """``"photos"``, or ``"gaussians"``: their colour without what changes with the direction,
    rendered from the photos' cameras."""
    max_atlases: int = 0
    """Textures that the mesh may be spread over where the photos show more than one holds; 0 is 1,
    or a few where one of the largest would not do."""


@dataclass(frozen=True)
class JobSettings:
    """All settings of one job."""

    preset: str = "standard"
    seed: int = 0
    threads: int = 0
    """0 uses every core this process may use."""
    regions: tuple[str, ...] = ("auto",)
    """``"auto"``, ``"all"``, or the path of a region file (method.md 7.3)."""
    export: tuple[str, ...] = ("glb",)
    start_splat: str = ""
    """PLY of Gaussians that training starts from; empty starts from the sparse points."""
    training: TrainingSettings = field(default_factory=TrainingSettings)
    meshing: MeshingSettings = field(default_factory=MeshingSettings)
    texture: TextureSettings = field(default_factory=TextureSettings)

    def validated(self) -> JobSettings:
        """Return self, or raise :class:`SettingError` naming the first setting out of range."""
        checks = (
            ("preset", self.preset in PRESETS, f"one of {', '.join(PRESETS)}"),
            ("threads", 0 <= self.threads <= 1024, "from 0 to 1024"),
            ("seed", 0 <= self.seed < 2**31, "from 0 to 2147483647"),
            ("regions", len(self.regions) > 0, "at least one region"),
            (
                "export",
                set(self.export) <= set(JOB_FORMATS),
                f"among {', '.join(JOB_FORMATS)}",
            ),
            ("training.iterations", 1 <= self.training.iterations <= 10**6, "from 1 to 1000000"),
            (
                "training.extra_iterations",
                0 <= self.training.extra_iterations <= 10**6,
                "from 0 to 1000000",
            ),
            (
                "training.max_gaussians",
                100 <= self.training.max_gaussians <= 20_000_000,
                "from 100 to 20000000",
            ),
            (
                "training.max_image_px",
                32 <= self.training.max_image_px <= 16384,
                "from 32 to 16384",
            ),
            ("training.sh_degree", 0 <= self.training.sh_degree <= 3, "from 0 to 3"),
            *(
                (f"training.{name}", getattr(self.training, name) in choices, _one_of(choices))
                for name, choices in _CHOICES.items()
            ),
            (
                "training.region_weight",
                1.0 <= self.training.region_weight <= 1000.0,
                "from 1 to 1000",
            ),
            (
                "training.pixels_per_iteration",
                1000 <= self.training.pixels_per_iteration <= 10**9,
                "from 1000 to 1000000000",
            ),
            (
                "training.overlap_price",
                0.0 <= self.training.overlap_price <= 1.0,
                "from 0 to 1",
            ),
            ("training.prune_share", 0.0 <= self.training.prune_share < 0.5, "from 0 to 0.5"),
            ("training.wrap_rounds", 0 <= self.training.wrap_rounds <= 20, "from 0 to 20"),
            ("training.holdout_every", 0 <= self.training.holdout_every <= 10**6, "0 or more"),
            *(
                (
                    f"training.{name}",
                    math.isfinite(getattr(self.training, name))
                    and getattr(self.training, name) >= 0.0,
                    "a number of seconds, 0 or more",
                )
                for name in RESULT_FREE
            ),
            (
                "training.multi_view_pixels",
                1 <= self.training.multi_view_pixels <= 10**6,
                "from 1 to 1000000",
            ),
            (
                "training.multi_view_every",
                1 <= self.training.multi_view_every <= 1000,
                "from 1 to 1000",
            ),
            (
                "meshing.edge_length",
                math.isfinite(self.meshing.edge_length) and self.meshing.edge_length >= 0,
                "a positive length",
            ),
            (
                "meshing.spacing",
                self.meshing.spacing in SPACINGS,
                _one_of(SPACINGS),
            ),
            (
                "meshing.tiles",
                self.meshing.tiles in ("auto", "off") or _is_count(self.meshing.tiles, MAX_TILES),
                f"auto, off, or from 1 to {MAX_TILES}",
            ),
            ("meshing.points", 0 <= self.meshing.points <= 5_000_000, "from 0 to 5000000"),
            ("meshing.method", self.meshing.method in MESH_METHODS, _one_of(MESH_METHODS)),
            (
                "meshing.pivots",
                self.meshing.pivots in PIVOT_COUNTS,
                _one_of(tuple(str(count) for count in PIVOT_COUNTS)),
            ),
            ("meshing.boundary", self.meshing.boundary in BOUNDARIES, _one_of(BOUNDARIES)),
            ("meshing.unseen", self.meshing.unseen in UNSEEN, _one_of(UNSEEN)),
            (
                "meshing.min_component_share",
                0.0 <= self.meshing.min_component_share <= 1.0,
                "from 0 to 1",
            ),
            (
                "meshing.target_faces",
                self.meshing.target_faces == 0 or 4 <= self.meshing.target_faces <= 20_000_000,
                "0 (all) or from 4 to 20000000",
            ),
            ("meshing.smooth_steps", 0 <= self.meshing.smooth_steps <= 1000, "from 0 to 1000"),
            (
                "texture.size_px",
                self.texture.size_px == 0 or 64 <= self.texture.size_px <= 8192,
                "0 (automatic) or from 64 to 8192",
            ),
            (
                "texture.max_atlases",
                0 <= self.texture.max_atlases <= MAX_ATLASES,
                f"0 (automatic) or from 1 to {MAX_ATLASES}",
            ),
            ("texture.gutter_px", 1 <= self.texture.gutter_px <= 64, "from 1 to 64"),
            ("texture.normal_map", self.texture.normal_map in DECISIONS, _one_of(DECISIONS)),
            (
                "texture.ambient_occlusion",
                self.texture.ambient_occlusion in SWITCH,
                _one_of(SWITCH),
            ),
            ("texture.lods", 0 <= self.texture.lods <= MAX_LODS, f"from 0 to {MAX_LODS}"),
            ("texture.source", self.texture.source in TEXTURE_SOURCES, _one_of(TEXTURE_SOURCES)),
        )
        for name, good, wanted in checks:
            if not good:
                raise SettingError(name, wanted)
        return self


def _is_count(text: str, most: int) -> bool:
    return text.isascii() and text.isdigit() and len(text) < 10 and 1 <= int(text) <= most


def _one_of(choices: tuple[str, ...]) -> str:
    return f"one of {', '.join(choices)}"


def preset(name: str, **overrides: Any) -> JobSettings:
    """Return the settings of ``"draft"``, ``"standard"`` or ``"fine"``."""
    if name not in PRESETS:
        raise UsageError(f"There is no preset {name!r}.", f"Choose one of {', '.join(PRESETS)}.")
    training = {
        "draft": TrainingSettings(
            iterations=1500, max_gaussians=40_000, max_image_px=480, sh_degree=1, wrap_rounds=2
        ),
        "standard": TrainingSettings(),
        "fine": TrainingSettings(
            iterations=4000, max_gaussians=120_000, max_image_px=1024, sh_degree=3, wrap_rounds=4
        ),
    }[name]
    return JobSettings(preset=name, training=training, **overrides)


def to_json(settings: Any) -> dict[str, Any]:
    """Turn a settings dataclass into plain JSON values."""
    return dataclasses.asdict(settings)


def from_json(kind: type, values: Any, place: str = "settings") -> Any:
    """Build a settings dataclass from JSON values; unknown keys and wrong types are refused.

    Raises
    ------
    UsageError
        Names the place and what was expected.
    """
    if not isinstance(values, dict):
        raise UsageError(f"{place} must be an object.", "Write it as {...}.")
    hints = typing.get_type_hints(kind)
    fields = {f.name for f in dataclasses.fields(kind)}
    unknown = sorted(set(values) - fields)
    if unknown:
        raise UsageError(f"{place} has an unknown entry {unknown[0]!r}.", "Remove it.")
    arguments = {}
    for name, value in values.items():
        wanted = hints[name]
        where = f"{place}.{name}"
        if dataclasses.is_dataclass(wanted):
            arguments[name] = from_json(typing.cast(type, wanted), value, where)
        elif wanted is float and isinstance(value, (int, float)) and not isinstance(value, bool):
            arguments[name] = float(value)
        elif wanted in (int, str) and type(value) is wanted:
            arguments[name] = value
        elif typing.get_origin(wanted) is tuple and isinstance(value, (list, tuple)):
            if not all(isinstance(v, str) for v in value):
                raise UsageError(f"{where} must hold only text.", "Use strings.")
            arguments[name] = tuple(value)
        else:
            raise UsageError(f"{where} has the wrong type.", f"Expected {wanted}.")
    return kind(**arguments)
