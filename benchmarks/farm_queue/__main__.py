# SPDX-License-Identifier: GPL-3.0-or-later
"""Many small wraps on a LocalCluster that is killed twice: ``python -m benchmarks.farm_queue``.

Small photo sets are made and queued on two Dask workers of this computer. SIGKILL ends a worker
with its job, later the queue's own process; the same command again must bring all jobs to their
end, with the results that they have alone, and leave nothing. The outcome is kept in
``benchmarks/records/farm_queue``, and ``docs/benchmarks/queue.md`` is written. Linux only:
processes are found in ``/proc``.
"""

from __future__ import annotations

import argparse
import dataclasses
import datetime
import logging
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gaussian_wrapping_addon.core.machine import processor_name

from ..study.command import DOCUMENTS
from ..study.record import code_of_tree
from ..tables import versions
from .checks import apart, files_of, left_behind, table_of, wrap_alone
from .document import write_document
from .outcome import Outcome, read_outcome, write_outcome
from .photo_sets import write_photo_sets, write_things_region
from .strikes import carry_out, command_of

_logger = logging.getLogger("benchmarks")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the queue and write the page; return 1 where anything was not as it should be."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.farm_queue",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--n", type=int, default=50, help="wraps")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--compare", type=int, default=6, help="wraps that are made alone as well")
    parser.add_argument("--document", action="store_true", help="run nothing, write the page")
    parser.add_argument("--out", type=Path, default=DOCUMENTS, help="folder of the page")
    options = parser.parse_args(arguments)
    if options.n < 8:
        parser.error("--n is too small for two strikes: give at least 8")
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    options.out.mkdir(parents=True, exist_ok=True)
    if options.document:
        outcome = read_outcome()
    else:
        with tempfile.TemporaryDirectory(prefix="queue-") as folder:
            outcome = _run(Path(folder), options.n, options.seed, options.compare)
        write_outcome(outcome)
    for fault in outcome.faults:
        _logger.error("%s", fault)
    _logger.info("%s", write_document(options.out, outcome))
    return int(bool(outcome.faults))


def _run(place: Path, count: int, seed: int, compare: int) -> Outcome:
    sets, out = place / "sets", place / "jobs"
    names = write_photo_sets(sets, count, seed)
    region = write_things_region(place / "things.json")
    wrap_alone(sets / names[0], place / "warm", region)  # compiles kernels
    _logger.info("%d sets are made", count)
    course = carry_out(command_of(sets, out, region), out, names, seed)
    for strike in course.strikes:
        _logger.info("%s was ended: %s", strike.what, strike.stages)
    _logger.info("queue: %.0f s, again: %.0f s", course.first_s, course.second_s)
    wanted = files_of(place / "warm")
    incomplete = [name for name in names if files_of(out / name) != wanted]
    struck = [name for strike in course.strikes for name in strike.stages]
    others = np.random.default_rng(seed).permutation(names).tolist()
    chosen = list(dict.fromkeys([*struck, *others]))[: max(compare, len(struck))]
    items, differing = 0, []
    for name in chosen:
        wrap_alone(sets / name, place / "alone" / name, region)
        items, found = apart(out / name, place / "alone" / name)
        differing += [f"{name}, {line}" for line in found]
        _logger.info("%s alone: %s", name, found or "the same")
    values = {f.name: getattr(course, f.name) for f in dataclasses.fields(course)}
    said = values.pop("said")
    left = [line.replace(str(place), "DIR") for line in values.pop("left")]
    return Outcome(
        seed=seed,
        rows=tuple(table_of(out)),
        processes_left=tuple(left),
        left_behind=tuple(left_behind(out, place / "temporary")),
        incomplete=tuple(incomplete),
        compared=tuple(chosen),
        items=items,
        differences=tuple(differing),
        traceback="Traceback" in said,
        code_name=code_of_tree().name,
        machine=f"{processor_name()}; {versions()}",
        date=datetime.date.today().isoformat(),
        **values,
    )


if __name__ == "__main__":
    raise SystemExit(main())
