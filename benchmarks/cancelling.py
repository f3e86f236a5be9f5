# SPDX-License-Identifier: GPL-3.0-or-later
"""How long a job goes on after it was cancelled, in each phase that its progress names.

``python -m benchmarks.cancelling examples/bananas --out DIR [--cold]`` starts a draft job, cancels
it (twice) in each phase soon after that phase was first seen, resumes it, and prints one line for
each: the seconds from the request to the end of the process. ``--cold`` keeps compiled kernels in
an empty folder, so that compilations are met as well.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from gaussian_wrapping_addon.core.jobs.client import JobClient
from gaussian_wrapping_addon.core.jobs.store.job_file import make_job
from gaussian_wrapping_addon.core.settings import preset

POLL_S = 0.02
LONGEST_DELAY_S = 2.0
WAIT_S = 60.0


def phase_of(stage: str, message: str) -> tuple[str, str]:
    """Return stage and message without its numbers."""
    return stage, re.sub(r"\d[\d.,]*", "#", message).strip()


def measure(source: Path, out: Path, iterations: int, seed: int) -> list[dict[str, object]]:
    """Cancel in every phase once; return where, how long it took and how the job ended."""
    settings = preset("draft")
    if iterations:
        settings = replace(settings, training=replace(settings.training, iterations=iterations))
    random = np.random.default_rng(seed)
    client = JobClient.start(out, make_job("wrap", source, settings.validated()))
    seen: set[tuple[str, str]] = set()
    rows: list[dict[str, object]] = []
    while True:
        status = client.poll()
        if not status.active:
            rows.append({"stage": "end", "state": status.state, "error": status.error})
            return rows
        phase = phase_of(status.stage, status.message)
        if status.state != "RUNNING" or not status.stage or phase in seen:
            time.sleep(POLL_S)
            continue
        seen.add(phase)
        time.sleep(float(random.uniform(0.0, LONGEST_DELAY_S)))
        before = client.poll()
        if not before.active:
            continue
        seen.add(phase_of(before.stage, before.message))
        asked_s = time.monotonic()
        client.cancel()
        client.cancel()
        after = client.wait(WAIT_S)
        row = {
            "stage": before.stage,
            "message": before.message,
            "seconds": round(time.monotonic() - asked_s, 2),
            "state": after.state,
        }
        rows.append(row)
        sys.stdout.write(json.dumps(row) + "\n")
        sys.stdout.flush()
        client = JobClient.resume(out)


def main() -> int:
    """Read the command line, measure, print the longest."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("source", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--iterations", type=int, default=0, help="0: those of the preset")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cold", action="store_true", help="begin without compiled kernels")
    options = parser.parse_args()
    if options.cold:
        os.environ["NUMBA_CACHE_DIR"] = str(options.out.with_name(options.out.name + "-kernels"))
    rows = measure(options.source.resolve(), options.out, options.iterations, options.seed)
    measured = [row for row in rows if "seconds" in row]
    longest = max(measured, key=lambda row: float(str(row["seconds"])))
    sys.stdout.write(f"{len(measured)} phases; longest: {json.dumps(longest)}; {rows[-1]}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
