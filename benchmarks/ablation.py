# SPDX-License-Identifier: GPL-3.0-or-later
"""Measure what multi-view terms, orientation and clones gain: ``python -m benchmarks.ablation``.

Every run is a job through the command line on photos of a scene whose surface is known exactly
(``benchmarks/scenes``), with three seeds. Each leaves a record in ``benchmarks/records/ablation``;
a run that has one is not made again, so that the study may take several sittings: stop the command
whenever you like. At the end, or with ``--document``, ``docs/benchmarks/ablation.md`` and its plot
are written from the records alone.
"""

from __future__ import annotations

from collections.abc import Sequence

from .ablation_study.document import write_document
from .ablation_study.plan import plan
from .study.command import run_study


def main(arguments: Sequence[str] | None = None) -> int:
    """Do what the command line asks for; return 1 where a run failed, else 0."""
    return run_study(arguments, __doc__, plan(), write_document)


if __name__ == "__main__":
    raise SystemExit(main())
