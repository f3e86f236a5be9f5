# SPDX-License-Identifier: GPL-3.0-or-later
"""A million points from fifty cameras as JSON: ``python -m benchmarks.meshing_study.vacancy_line``.

The measurement itself is :mod:`benchmarks.meshing_parts.vacancy_scale`.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Sequence
from pathlib import Path

from gaussian_wrapping_addon.core.files import write_json

from ..meshing_parts.vacancy_scale import measure


def main(arguments: Sequence[str] | None = None) -> None:
    """Write the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--points", type=int, default=1_000_000)
    parser.add_argument("--threads", type=int, default=0)
    options = parser.parse_args(arguments)
    figures = measure(points=options.points, threads=options.threads)
    write_json(options.out, {**dataclasses.asdict(figures), "seconds": figures.seconds})


if __name__ == "__main__":
    main()
