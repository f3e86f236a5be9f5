# SPDX-License-Identifier: GPL-3.0-or-later
"""Compare what two versions of the add-on compute, bit for bit.

``python tools/compare_versions.py --against COMMIT`` runs the same commands on the same inputs with
the code of that commit and with the present tree, and compares every array, picture, mesh file,
figure and folder name. It prints what was compared and what differs, and ends with 1 where
anything does. Results of the commit are kept, so a second run costs the present side only.
What is not compared, and why, stands in ``version_comparison/contents.py``.
"""

from __future__ import annotations

import argparse
import shutil
import sys
from collections import Counter
from pathlib import Path

from version_comparison.cases import CASES, Case
from version_comparison.contents import differences, read_contents
from version_comparison.scene import write_inputs
from version_comparison.sides import (
    SideError,
    cache_key,
    checkout,
    commit_of,
    locked,
    run_cases,
)

ROOT = Path(__file__).resolve().parents[1]
MOST_SHOWN = 25
"""Differences of a case that are printed."""


def main() -> int:
    """Run both sides and print the table; 0 where all is the same, 1 where not, 2 on a failure."""
    parser = argparse.ArgumentParser(description="Compare two versions bit for bit.")
    parser.add_argument("--against", required=True, metavar="COMMIT")
    parser.add_argument("--quick", action="store_true", help="the first case only")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="copy what both sides wrote there")
    parser.add_argument("--tree", type=Path, default=ROOT, help="the new side; default: this tree")
    parser.add_argument("--cache", type=Path, help="default: .cache/versions of the tree")
    options = parser.parse_args()
    tree = options.tree.resolve()
    cache = (options.cache or tree / ".cache" / "versions").resolve()
    try:
        with locked(cache):
            cases = CASES[:1] if options.quick else CASES
            old, new = _both_sides(options.against, tree, cache, cases)
            if options.keep is not None:
                for name, side in (("old", old), ("new", new)):
                    shutil.copytree(side, options.keep / name, dirs_exist_ok=True)
            return _print_table(old, new, cases)
    except SideError as error:
        print(error)
        return 2


def _both_sides(against: str, tree: Path, cache: Path, cases: tuple[Case, ...]) -> tuple[Path, ...]:
    """Return the folders of what the old version and the new one wrote."""
    commit = commit_of(tree, against)
    inputs, run = cache / "inputs", cache / "run"
    shutil.rmtree(inputs, ignore_errors=True)
    write_inputs(inputs)
    key = cache_key(commit, inputs)
    full, quick = (cache / "results" / f"{commit[:12]}-{key}-{name}" for name in ("all", "quick"))
    wanted = full if len(cases) == len(CASES) else quick
    found = [path for path in (full, wanted) if (path / "seconds.json").is_file()]
    if found:
        old = found[0]
        print(f"{commit[:12]}: results of an earlier run")
    else:
        old = wanted
        seconds = run_cases(checkout(tree, commit, cache), cases, inputs, run, old)
        print(f"{commit[:12]}: run in {sum(seconds.values()):.0f} s")
    new = cache / "results" / "present"
    seconds = run_cases(tree, cases, inputs, run, new)
    print(f"present tree: run in {sum(seconds.values()):.0f} s")
    return old, new


def _print_table(old: Path, new: Path, cases: tuple[Case, ...]) -> int:
    kinds = ("file", "array", "image", "bytes", "json", "usd")
    print(f"\n{'case':42}", *(f"{kind:>7}" for kind in kinds), "left out  differ")
    lines: list[str] = []
    total = 0
    for case in cases:
        a, b = read_contents(old / case.folder), read_contents(new / case.folder)
        found = differences(a, b)
        counts = Counter(item.kind for item in a.items.values())
        print(
            f"{case.name:42}", *(f"{counts[kind]:7d}" for kind in kinds),
            f"{a.left_out:8d} {len(found):7d}",
        )  # fmt: skip
        lines += [f"  {case.name}: {name}: {how}" for name, how in found[:MOST_SHOWN]]
        if len(found) > MOST_SHOWN:
            lines.append(f"  {case.name}: and {len(found) - MOST_SHOWN} more")
        total += len(found)
    if total:
        print(f"\n{total} differences (old | new):", *lines, sep="\n")
    else:
        print("\nno difference")
    return 1 if total else 0


if __name__ == "__main__":
    sys.exit(main())
