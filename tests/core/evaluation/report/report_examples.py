# SPDX-License-Identifier: GPL-3.0-or-later
"""A report with every figure that a job measures, for tests of the report."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from PIL import Image

from gaussian_wrapping_addon.core.evaluation.report.report import write_report
from gaussian_wrapping_addon.core.progress import ReportWarning

REGION = "stem_1"
PICTURES = (
    "preview.png",
    "report/learning-curve.svg",
    "report/held-out-0.jpg",
    "report/held-out-1.jpg",
    f"{REGION}/preview.png",
    f"{REGION}/comparison-1.jpg",
)


def full_summary() -> dict[str, Any]:
    """What the runner measures of a whole job, with hostile names in it."""
    return {
        "command": "wrap",
        "source": "a|b <i>*photos*</i>",
        "settings": {
            "preset": "draft",
            "seed": 7,
            "training": {"iterations": 300, "lambda_normal": 0.03, "depth_from": 0.25},
            "meshing": {"edge_length": 0.0, "min_component_share": 0.01},
            "texture": {"size_px": 0, "gutter_px": 8},
        },
        "machine": {
            "processor": "Some CPU",
            "cores": 2,
            "threads": 2,
            "memory_bytes": 8 * 2**30,
            "system": "Linux x86_64",
            "python": "3.11.7",
            "packages": {"numpy": "1.26.4", "numba": "0.68.1"},
        },
        "device": "cuda:1",
        "device_reason": "Some GPU, kernels compiled by libnvrtc.so.13.",
        "started_unix_s": 1795271321.2,
        "wall_seconds": 201.5,
        "peak_memory_bytes": {"worker": 3 * 2**30, "largest_helper": 2**29},
        "stages": [
            {"name": "cameras", "seconds": 20.0, "reused": True},
            {"name": "train", "seconds": 140.0, "reused": False},
            {"name": f"mesh-{REGION}", "seconds": 30.0, "reused": False},
            {"name": f"texture-{REGION}", "seconds": 10.0, "reused": False},
        ],
        "cameras": {
            "views": 14,
            "points": 6333,
            "warnings": [
                ReportWarning(
                    "photos-not-placed",
                    "2 of 16 photos could not be placed and are not used: a|b.jpg, c.jpg.",
                    "Take more photos with more overlap there.",
                ).to_json()
            ],
            "facts": {
                "kind": "photos",
                "camera_models": ["SIMPLE_RADIAL"],
                "mean_reprojection_error_px": 3.5,
                "photo_sizes": ["998 x 664"],
            },
        },
        "training": {
            "gaussians": 12235,
            "iterations": 300,
            "held_out": [
                {"name": "p|q.jpg", "psnr": 20.0, "ssim": 0.5},
                {"name": "r.jpg", "psnr": 26.0, "ssim": 0.7},
            ],
            "held_out_psnr": 23.0,
            "held_out_ssim": 0.6,
            "lpips_note": "LPIPS is not measured: AlexNet's weights are not here.",
            "history": [
                {"iteration": 100.0, "loss": 0.2, "psnr": 25.0, "gaussians": 9000.0},
                {"iteration": 200.0, "loss": 0.15, "psnr": 28.0, "gaussians": 10000.0},
                {"iteration": 300.0, "loss": 0.1, "psnr": 30.0, "gaussians": 12235.0},
            ],
            "warnings": [
                ReportWarning(
                    "training-went-back",
                    "Training went back once, because numbers were not finite.",
                    "Train again.",
                ).to_json()
            ],
            "pictures": [
                {"file": "held-out-0.jpg", "name": "p|q.jpg", "psnr": 20.0},
                {"file": "held-out-1.jpg", "name": "r.jpg", "psnr": 26.0},
            ],
        },
    }


def full_region() -> dict[str, Any]:
    """What the stages measure of one region."""
    return {
        "statistics": {
            "vertices": 100,
            "faces": 196,
            "boundary_edges": 4,
            "components": 1,
            "volume": 0.5,
            "area": 3.25,
            "mean_edge": 0.02,
            "closed": False,
        },
        "provenance": {
            "method": "primal adaptive meshing",
            "notes": [
                ReportWarning(
                    "edge-length-reduced", "The edge length was raised to 0.02."
                ).to_json()
            ],
            "vertices_on_surface": 80,
            "vertices_on_region_boundary": 20,
            "degenerate_faces_left": 3,
            "removed_area_share": 0.0,
            "level_error_mean": 0.003,
            "level_error_median": 0.002,
            "level_error_p95": 0.03,
            "level_error_p99": 0.31,
            "level_error_max": 0.45,
        },
        "texture": {
            "size_px": 512,
            "size_automatic": True,
            "charts": 12,
            "utilisation": 0.5,
            "stretch_mean": 1.07,
            "stretch_p95": 1.31,
            "texels_used": 1000,
            "texels_overlapping": 2,
            "coverage": 0.25,
            "area_seen_share": 0.3,
            "area_without_texel_share": 0.02,
            "faces_without_texel": 5,
            "views_per_seen_texel": 4.0,
            "unwrap_fallback_reason": "the unwrapper crashed",
        },
        "world": {
            "size": [1.0, 2.0, 3.5],
            "diagonal": 4.2,
            "area": 13.0,
            "edge_mean": 0.04,
            "edge_median": 0.03,
            "texels_per_unit": 8.8,
            "texel_size": 0.114,
        },
        "mesh_rendering": {
            "views": [
                {
                    "name": "p|q.jpg",
                    "psnr": 18.5,
                    "ssim": 0.45,
                    "covered": 0.75,
                    "uncovered": 0.125,
                    "whole_psnr": 9.5,
                    "picture": "comparison-1.jpg",
                },
                {
                    "name": "r.jpg",
                    "psnr": 21.5,
                    "ssim": 0.55,
                    "covered": 0.5,
                    "uncovered": 0.375,
                    "whole_psnr": 6.5,
                },
            ],
            "psnr": 20.0,
            "ssim": 0.5,
            "covered": 0.625,
            "uncovered": 0.25,
            "whole_psnr": 8.0,
            "pixels": "covered",
            "held_out": True,
            "note": "the texture compared was baked without the held-out photos",
            "lpips_note": "its weights are not here",
            "pictures": ["comparison-1.jpg"],
        },
        "seconds": {"mesh": 30.0, "texture": 10.0},
    }


def write_pictures(result: Path) -> None:
    """Put a file at the place of every picture."""
    for name in PICTURES:
        path = result / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix == ".svg":
            path.write_text("<svg/>")
        else:
            Image.new("RGB", (4, 4)).save(path)


def write(
    folder: Path, summary: dict[str, Any] | None = None, regions: dict[str, Any] | None = None
) -> tuple[dict[str, Any], str]:
    """Write a report; return what both files hold."""
    summary = full_summary() if summary is None else summary
    write_report(folder, summary, {REGION: full_region()} if regions is None else regions)

    def refuse(name: str) -> Any:
        raise AssertionError(name)

    values = json.loads((folder / "report.json").read_text(), parse_constant=refuse)
    return values, (folder / "report.md").read_text(encoding="utf-8")


def section(text: str, heading: str) -> str:
    """Return the lines below a heading, up to the next of its rank."""
    rank = heading.split(" ")[0]
    begin = text.index(f"\n{heading}\n")
    end = text.find(f"\n{rank} ", begin + len(heading))
    return text[begin : end if end >= 0 else len(text)]
