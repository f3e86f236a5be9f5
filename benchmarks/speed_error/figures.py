# SPDX-License-Identifier: GPL-3.0-or-later
"""The plots of the report: what time, vertices, texels and Gaussians buy."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path

from gaussian_wrapping_addon.core.evaluation.report.plot import Panel, Series, write_svg

from .plan import MAIN_SCENES
from .results import Result, plain
from .tables import MIDDLE, SHARES
from .varied_tables import varied

Value = Callable[[Result], float]


def write_plots(results: Sequence[Result], long_side_px: int, path: Path) -> None:
    """Write all panels into one SVG; the photos' own long side bounds that of training images."""

    def image_side(result: Result) -> float:
        return min(result.report["settings"]["training"]["max_image_px"], long_side_px)

    texels = [
        _varied(results, "texture", lambda r: r.scores["texture_side_px"] ** 2, _texture_psnr)
    ]
    panels = [
        Panel(
            "Time against F1, presets",
            "whole command, s",
            f"F1 at {SHARES[MIDDLE]}",
            _presets(results, lambda r: r.f1("uniform", MIDDLE)),
            legend_low=True,
            y_log=False,
        ),
        Panel(
            "Time against F1, seen surface only",
            "whole command, s",
            f"scan F1 at {SHARES[MIDDLE]}",
            _presets(results, lambda r: r.f1("scan", MIDDLE)),
            legend_low=True,
            y_log=False,
        ),
        Panel(
            "Time against images",
            "whole command, s",
            "textured mesh at test views, PSNR dB",
            _presets(results, _texture_psnr),
            legend_low=True,
            y_log=False,
        ),
        Panel(
            "Vertices against distance",
            "vertices",
            "Chamfer, % of the diagonal",
            [
                _varied(
                    results, "points", lambda r: r.scores["vertices"],
                    lambda r: _percent(r.share("chamfer_mean")), scene,
                )
                for scene in ("spot", "wheel")
            ],
        ),
        Panel("Texels against images", "texels", "textured mesh, PSNR dB", texels, y_log=False),
        Panel(
            "Gaussians against images",
            "Gaussians",
            "Gaussians at test views, PSNR dB",
            [_varied(results, "gaussians", _count, lambda r: r.scores["gaussians"]["psnr"])],
            y_log=False,
        ),
        Panel(
            "Gaussians against surface",
            "Gaussians",
            f"F1 at {SHARES[MIDDLE]}",
            [_varied(results, "gaussians", _count, lambda r: r.f1("uniform", MIDDLE))],
            y_log=False,
        ),
        Panel(
            "Training images against surface",
            "long side, px",
            f"F1 at {SHARES[MIDDLE]}",
            [_varied(results, "image", image_side, lambda r: r.f1("uniform", MIDDLE))],
            y_log=False,
        ),
    ]  # fmt: skip
    write_svg(panels, path)


def _texture_psnr(result: Result) -> float:
    return math.nan if result.texture_psnr is None else result.texture_psnr


def _percent(share: float | None) -> float:
    return math.nan if share is None else 100 * share


def _count(result: Result) -> float:
    return float(result.scores["gaussians"]["count"])


def _presets(results: Sequence[Result], value: Value) -> list[Series]:
    series = []
    for scene in MAIN_SCENES:
        same = plain(results, scene)
        points = [(r.wall_s, value(r)) for r in same]
        series.append(Series(scene, points, labels=tuple(r.run.preset for r in same)))
    return series


def _varied(
    results: Sequence[Result], name: str, x: Value, y: Value, scene: str = "spot"
) -> Series:
    same = varied(results, name, (scene,))
    return Series(scene, [(float(x(r)), float(y(r))) for r in same])
