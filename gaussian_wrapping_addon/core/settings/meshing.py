# SPDX-License-Identifier: GPL-3.0-or-later
"""Settings of the meshing."""

from __future__ import annotations

from dataclasses import dataclass

from ..limits import ISO_LEVEL, MAX_TILES, SHORTEST_EDGE
from .declaration import (
    BOUNDARIES,
    FIELD_CAMERAS,
    MESH_METHODS,
    PIVOT_BOXES,
    PIVOT_COUNTS,
    PIVOT_SAMPLES,
    SPACINGS,
    UNSEEN,
    Choices,
    Condition,
    Item,
    Option,
    PanelProperty,
    Range,
    setting,
)


def _is_tiles(text: str) -> bool:
    if text in ("auto", "off"):
        return True
    is_number = text.isascii() and text.isdigit() and len(text) < 10
    return is_number and 1 <= int(text) <= MAX_TILES


# Packed, as a survey of all settings needs few lines.
# fmt: off
@dataclass(frozen=True)
class MeshingSettings:
    """How a region is meshed. ``edge_length`` or ``points`` sets the resolution; 0 is unset."""

    edge_length: float = setting(
        0.0,
        help="Target edge length. With adaptive spacing the mesh comes as close to the surface as "
        "a uniform one with such edges, with about half as many vertices. 0 leaves the resolution "
        "to `points`, or to the photos.",
        check=Range(
            SHORTEST_EDGE, zero="automatic",
            words=f"a positive length of at least {SHORTEST_EDGE:g}",
        ),
        unit="world units",
        option=Option(
            "--edge-length", "X",
            "target edge length, world units of the input; 0, the default, is automatic",
            scope="method", exclusive="resolution", own=True,
        ),
        panel=PanelProperty(
            "Edge Length", "Length of triangle edges, as seen in Blender", default=0.05, low=1e-5,
            soft_high=1.0, precision=4, subtype="DISTANCE", unit="LENGTH", panel_name="mesh",
            shown_if=("resolution", "EDGE_LENGTH"), default_if_hidden=True,
        ),
    )
    points: int = setting(
        0,
        help="Target number of surface points; 0 leaves the resolution to `edge_length`, or to the "
        "photos.",
        check=Range(0, 5_000_000), unit="points",
        option=Option(
            "--points", "N", "target number of surface points", scope="method",
            exclusive="resolution", own=True,
        ),
        panel=PanelProperty(
            "Points", "Number of points on the surface of a region", default=50_000, low=100,
            soft_high=500_000, panel_name="mesh", shown_if=("resolution", "POINTS"),
            default_if_hidden=True,
        ),
    )
    spacing: str = setting(
        "adaptive",
        help="Spacing of the vertices. adaptive: dense where the shape needs it, no denser than "
        "the photos resolve; uniform: the same edge length everywhere.",
        check=Choices(SPACINGS),
        option=Option(
            "--spacing", help="spacing of the mesh's vertices (default: adaptive)", scope="method",
        ),
        panel=PanelProperty(
            "Spacing", "Distribution of the vertices",
            items=(
                Item(
                    "adaptive", "Adaptive",
                    "Dense where the shape needs it: as accurate with half as many vertices",
                ),
                Item("uniform", "Uniform", "The same edge length everywhere: even triangles"),
            ),
            order=50, shown_if=("method", "PAM"),
        ),
    )
    tiles: str = setting(
        "auto",
        help="Tiles that the region is meshed in to bound memory: a number; auto: as many as the "
        "request needs; off: one.",
        check=Condition(_is_tiles, f"auto, off, or from 1 to {MAX_TILES}"),
        option=Option(
            "--tiles", "auto|off|N",
            "tiles that a large region is meshed in to bound memory (default: auto)",
            scope="method",
        ),
    )
    method: str = setting(
        "pam",
        help="Meshing method. pam: primal adaptive meshing; pivots: marching tetrahedra on the "
        "Gaussians' pivots, as fine as the Gaussians are: edge length, number of points, spacing "
        "and tiles do not apply.",
        check=Choices(MESH_METHODS),
        option=Option(
            "--method",
            help="primal adaptive meshing, or marching tetrahedra on the Gaussians' pivots",
            scope="method",
        ),
        panel=PanelProperty(
            "Method", "How the mesh is made",
            items=(
                Item("pam", "Adaptive", "Primal adaptive meshing: at the chosen resolution"),
                Item(
                    "pivots", "Pivots",
                    "Marching tetrahedra on the Gaussians' pivots: as fine as the Gaussians",
                ),
            ),
            order=30,
        ),
    )
    pivots: int = setting(
        2, help="Pivots of each Gaussian; only with the method pivots.",
        check=Choices(PIVOT_COUNTS), unit="points",
        option=Option(
            "--pivots", help="pivots of each Gaussian, with --method pivots (default: 2)",
            scope="method",
        ),
        panel=PanelProperty(
            "Pivots", "Points of each Gaussian",
            items=(
                Item(2, "2", "Centre and outer pivot"),
                Item(3, "3", "Outer pivots on both sides"),
                Item(9, "9", "Centre and the corners of a box; several times as many triangles"),
            ),
            order=40, shown_if=("method", "PIVOTS"),
        ),
    )
    pivot_box: str = setting(
        "normal",
        help="Box of nine pivots. normal: along the normal and two directions across it, as in the "
        "paper; gof: along the Gaussian's own axes, as in Gaussian Opacity Fields.",
        check=Choices(PIVOT_BOXES),
        option=Option(
            "--pivot-box",
            help="box of --pivots 9: along the normal (default), or the Gaussian's own axes (gof)",
            scope="method",
        ),
        panel=PanelProperty(
            "Pivot Box", "Box of nine pivots",
            items=(
                Item("normal", "Normal", "Along the normal and two directions across it"),
                Item("gof", "GOF", "Along the Gaussian's own axes, as in Gaussian Opacity Fields"),
            ),
            order=41, shown_if=("method", "PIVOTS"),
        ),
    )
    pivot_samples: str = setting(
        "depth",
        help="Points that the method pivots triangulates besides the pivots. depth: points of the "
        "cameras' depth maps, and some throughout the region; none: the pivots alone, of faint "
        "Gaussians too, as in the paper.",
        check=Choices(PIVOT_SAMPLES),
        option=Option(
            "--pivot-samples",
            help="points besides the pivots of --method pivots: of depth maps (default), or none",
            scope="method",
        ),
        panel=PanelProperty(
            "Pivot Samples", "Points that are triangulated besides the pivots",
            items=(
                Item("depth", "Depth Maps", "Points that the cameras see: keeps thin parts"),
                Item("none", "None", "The pivots alone: the mesh of the paper"),
            ),
            order=42, shown_if=("method", "PIVOTS"),
        ),
    )
    boundary: str = setting(
        "closed",
        help="Mesh where the region cuts the solid. closed: faces on the region's planes close it; "
        "open: these faces are left out.",
        check=Choices(BOUNDARIES),
        option=Option(
            "--boundary", help="where the region cuts the solid: closed by faces, or open",
        ),
        panel=PanelProperty(
            "Boundary", "How the mesh ends at the region's boundary",
            items=(
                Item(
                    "closed", "Closed",
                    "Flat faces close the mesh where the region cuts through objects",
                ),
                Item("open", "Open", "The mesh ends there with an open edge"),
            ),
        ),
    )
    unseen: str = setting(
        "empty", help="Space that no camera sees: empty or occupied.", check=Choices(UNSEEN),
        option=Option("--unseen", help="space that no camera sees: empty, or occupied"),
        panel=PanelProperty(
            "Unseen", "Space that no camera sees",
            items=(
                Item("empty", "Empty", "Space that no camera sees is empty"),
                Item("occupied", "Occupied", "It is solid: closes the backs of objects"),
            ),
        ),
    )
    level: float = setting(
        ISO_LEVEL,
        help="Vacancy at which the surface is. Above 0.5 thin parts hold together that the photos "
        "show as 1 or 2 pixels, and everything is a little fatter.",
        check=Range(0.3, 0.9), since="0.2.0", unit="vacancy",
        option=Option("--level", help="vacancy at which the surface is (default: 0.5)"),
    )
    blur_variance: float = setting(
        0.25,
        help="Variance of the blur of lens and pixels: thin parts get the opacity back that it "
        "takes from them. 0: Gaussians as they were trained, as published.",
        check=Range(0.0, 1.0), presets={"paper": 0.0}, since="0.2.0", unit="squared pixels",
        option=Option(
            "--blur-variance", "X", "variance of the photos' blur, which takes opacity from rods",
        ),
    )
    cameras: str = setting(
        "training",
        help="Cameras that the mesh is made from. training: those that were trained on, as the "
        "method has it; all: those of held-out and of wholly masked photos as well.",
        check=Choices(FIELD_CAMERAS),
        option=Option(
            "--mesh-cameras",
            help="cameras that the mesh is made from: those trained on (default), or all, held-out "
            "ones too",
        ),
        panel=PanelProperty(
            "Cameras", "Cameras that the mesh is made from", name="mesh_cameras",
            items=(
                Item(
                    "training", "Training",
                    "Those that were trained on; held-out photos only measure",
                ),
                Item("all", "All", "Held-out photos carve the mesh, too"),
            ),
        ),
    )
    min_component_share: float = setting(
        0.01,
        help="Components with less area than this share of the largest, and shorter than three "
        "times this share of the longest, are removed and counted.",
        check=Range(0.0, 1.0), unit="share",
        option=Option(
            "--min-part", "SHARE",
            "remove components of less area than this share of the largest, but no long ones; "
            "0 for none",
        ),
    )
    most_parts: int = setting(
        0,
        help="Of the components that are left, so many of the largest area stay; 0 keeps all. An "
        "open boundary is cut afterwards, and may cut one into several.",
        check=Range(1, 10_000, zero="all"), since="0.2.0", unit="parts",
        option=Option("--parts", "N", "keep the N largest parts; 0 keeps all"),
        panel=PanelProperty(
            "Largest Parts", "Number of parts that stay, by area; 0 keeps all but tiny ones",
            soft_high=20, order=5,
        ),
    )
    target_faces: int = setting(
        0, help="The mesh is decimated to this number of faces; 0 keeps all.",
        check=Range(4, 20_000_000, zero="all"), unit="faces",
        option=Option("--faces", "N", "decimate the mesh to N faces; 0 keeps all", own=True),
        panel=PanelProperty(
            "Faces", "Number of triangles that the mesh is decimated to", default=20_000, low=4,
            soft_high=1_000_000, order=10, shown_if=("decimate", True), default_if_hidden=True,
        ),
    )
    smooth_steps: int = setting(
        0, help="Steps of volume-preserving smoothing; 0 smooths nothing.", check=Range(0, 1000),
        unit="steps",
        option=Option("--smooth", "N", "steps of volume-preserving smoothing; 0 for none"),
        panel=PanelProperty(
            "Smooth Steps",
            "Steps of volume-preserving smoothing; 0 leaves the surface as measured", soft_high=20,
            order=20,
        ),
    )
# fmt: on
