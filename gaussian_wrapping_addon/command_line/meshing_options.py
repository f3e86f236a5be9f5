# SPDX-License-Identifier: GPL-3.0-or-later
"""Options that become settings of meshes and textures, of all commands that make one."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from .texture_options import add_texture_options, texture_settings

if TYPE_CHECKING:
    from ..core.settings import JobSettings

MESHING: tuple[tuple[str, str, type, str, str], ...] = (
    ("--faces", "target_faces", int, "N", "decimate the mesh to N faces; 0 leaves all"),
    ("--smooth", "smooth_steps", int, "N", "steps of smoothing that keeps the volume; 0 for none"),
    (
        "--min-part",
        "min_component_share",
        float,
        "SHARE",
        "remove parts of less area than this share of the largest, but no long ones; 0 for none",
    ),
)
"""Options that name one number of the meshing: its setting, their type, placeholder and help."""

METHOD = {
    "method": "primal adaptive meshing, or marching tetrahedra on the Gaussians' pivots",
    "pivots": "of each Gaussian, with --method pivots (default: 2)",
    "spacing": "of the mesh's vertices (default: adaptive)",
}
"""Settings of how a mesh is made that an option of their name chooses: its help."""

CHOICES = {
    "boundary": "of the region where it cuts a solid: faces close it there, or it stays open",
    "unseen": "what stands where no camera looks: nothing, or something",
}
"""The same of which field it is made, and how it ends."""


def add_method_options(parser: ArgumentParser) -> None:
    """Add how a mesh is made, and how finely."""
    from ..core.settings import MESH_METHODS, PIVOT_COUNTS, SPACINGS

    size = parser.add_mutually_exclusive_group()
    size.add_argument("--edge-length", type=float, metavar="X", help="world units of the input")
    size.add_argument("--points", type=int, metavar="N", help="number of surface points")
    of_option = zip(METHOD, (MESH_METHODS, PIVOT_COUNTS, SPACINGS), strict=True)
    for name, choices in of_option:
        parser.add_argument(f"--{name}", type=type(choices[0]), choices=choices, help=METHOD[name])
    parser.add_argument(
        "--tiles",
        metavar="auto|off|N",
        help="parts that a large region is meshed in, so that memory stays bounded (default: auto)",
    )


def add_boundary_options(parser: ArgumentParser) -> None:
    """Add of which field a mesh is made, and how it ends at the region's boundary."""
    from ..core.settings import BOUNDARIES, UNSEEN, MeshingSettings

    for name, choices in zip(CHOICES, (BOUNDARIES, UNSEEN), strict=True):
        default = getattr(MeshingSettings(), name)
        parser.add_argument(f"--{name}", choices=choices, default=default, help=CHOICES[name])


def method_settings(options: Namespace) -> dict[str, Any]:
    """Return the meshing settings that :func:`add_method_options` was given.

    What was not given has its default, not that of an earlier mesh.

    Raises
    ------
    UsageError
        An option is given that the method does not heed.
    """
    from ..core.errors import UsageError
    from ..core.settings import MeshingSettings

    default = MeshingSettings()
    names = (*METHOD, "edge_length", "points", "tiles")
    given = {name: value for name in names if (value := getattr(options, name)) is not None}
    method = given.get("method", default.method)
    if method == "pivots":
        # An edge length or number of 0 asks for none, and these words for what pivots do anyway.
        idle = {"edge_length": (0.0,), "points": (0,), "tiles": ("auto", "off")}
        for name in ("edge_length", "points", "spacing", "tiles"):
            if name in given and given[name] not in idle.get(name, ()):
                option = "--" + name.replace("_", "-")
                raise UsageError(
                    f"{option} {given[name]} does not go with --method pivots, which is as fine "
                    "as the Gaussians lie and makes the mesh whole.",
                    f"Leave one of the two out; --method pam heeds {option}.",
                )
    elif "pivots" in given:
        raise UsageError(
            f"--pivots {given['pivots']} does not go with --method {method}.",
            "Add --method pivots, or leave --pivots out.",
        )
    return {name: given.get(name, getattr(default, name)) for name in names}


def boundary_settings(options: Namespace) -> dict[str, Any]:
    """Return the meshing settings that :func:`add_boundary_options` was given."""
    return {name: getattr(options, name) for name in CHOICES}


def add_clean_up_options(parser: ArgumentParser) -> None:
    """Add what happens to a mesh after it was made."""
    for option, name, kind, metavar, text in MESHING:
        parser.add_argument(option, dest=name, type=kind, metavar=metavar, help=text)


def clean_up_settings(options: Namespace) -> dict[str, Any]:
    """Return the meshing settings that :func:`add_clean_up_options` was given.

    What was not given has its default, not that of an earlier mesh, as the edge length has.
    """
    from ..core.settings import MeshingSettings

    default = MeshingSettings()
    given = {name: getattr(options, name) for _, name, *_ in MESHING}
    return {n: getattr(default, n) if value is None else value for n, value in given.items()}


def add_region_options(parser: ArgumentParser) -> None:
    """Add what ``wrap`` and ``mesh`` share: regions, the field, clean-up, texture, files."""
    from ..core.export_formats import JOB_FORMATS

    parser.add_argument("--region", nargs="+", action="extend", metavar="auto|all|REGION.json")
    add_boundary_options(parser)
    add_clean_up_options(parser)
    parser.add_argument("--texture-size", default="auto", metavar="auto|N")
    add_texture_options(parser)
    parser.add_argument(
        "--export", default="glb", help=f"comma separated, of {','.join(JOB_FORMATS)}"
    )


def region_settings(settings: JobSettings, options: Namespace) -> JobSettings:
    """Return settings with what :func:`add_method_options` and :func:`add_region_options` gave."""
    from ..core.errors import UsageError

    size = options.texture_size
    if size != "auto" and not size.isdecimal():
        raise UsageError(
            f"--texture-size {size} is not a number.", "Give auto or a size in pixels."
        )
    return replace(
        settings,
        threads=options.threads,
        regions=tuple(dict.fromkeys(options.region or ["auto"])),
        export=tuple(dict.fromkeys(f for f in options.export.split(",") if f)),
        meshing=replace(
            settings.meshing,
            **method_settings(options),
            **boundary_settings(options),
            **clean_up_settings(options),
        ),
        texture=replace(
            settings.texture,
            size_px=0 if size == "auto" else int(size),
            **texture_settings(options),
        ),
    )
