# SPDX-License-Identifier: GPL-3.0-or-later
"""Records of runs, resuming from them, and statistics over seeds."""

from __future__ import annotations

import dataclasses
import json
import math
import statistics
from pathlib import Path
from typing import Any

import pytest

from benchmarks import runs, study
from benchmarks.provenance import ROOT, STAGE_VERSIONS, code_of_tree
from benchmarks.runs import Photos, Run, Settings, warm_up
from benchmarks.study import (
    Case,
    Record,
    carry_out,
    kept_scores,
    made_by,
    named,
    options,
    read_record,
    read_records,
    record_path,
    said_versions,
    write_record,
)
from benchmarks.tables import Spread, shown
from gaussian_wrapping_addon.core.errors import ParseError, UsageError, WorkerError
from tests.benchmarks.invented_records import CODE, invented, surface

PLAN = [
    Case("trial", scene, name, seed, "draft", ("--iterations", "10"))
    for seed in (0, 1)
    for scene in ("wheel", "spot")
    for name in ("one", "two")
]


@pytest.fixture
def records(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of records instead of the repository's."""
    for function in (record_path, read_records):
        monkeypatch.setattr(
            study, function.__name__, lambda x, root=tmp_path, f=function: f(x, root)
        )
    return tmp_path


class Maker:
    """Makes records without running anything."""

    def __init__(self, folder: Path, fails: tuple[str, ...] = ()) -> None:
        self.folder, self.fails, self.made = folder, fails, list[str]()

    def __call__(self, case: Case, *, threads: int, kept: Path) -> Record:
        self.made.append(case.identity)
        if case.identity in self.fails:
            raise WorkerError("It failed.")
        found = invented(case)
        write_record(found, self.folder)
        return found


@pytest.fixture(autouse=True)
def _cold(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(study, "warm_up", lambda *_: None)


def test_records_come_back_as_they_were(tmp_path: Path) -> None:
    base = Case("trial", "wheel", "x", 2, "fine", (), "wheel-y-seed2", Photos(3, 40, 30))
    for made in (invented(PLAN[0]), invented(base, load_before=None, mbr={"psnr": 25.5})):
        path = write_record(made, tmp_path)
        assert path == tmp_path / "trial" / f"{made.case.identity}.json"
        assert read_record(path) == made
        assert path.stat().st_size < 4096


def test_processor_seconds_that_are_not_known_are_no_number() -> None:
    made = invented(PLAN[0])
    assert made.processor("train", "mesh") == 80.0
    assert made.spent_s == 90.0
    made.processor_s["mesh"] = None
    assert math.isnan(made.processor("train", "mesh"))
    assert math.isnan(made.processor("nothing"))
    assert made.processor("train") == 60.0


def test_a_record_holds_no_figure_that_json_lacks(tmp_path: Path) -> None:
    path = write_record(invented(PLAN[0], wall_s=float("nan")), tmp_path)
    assert read_record(path).wall_s is None


@pytest.mark.parametrize(
    "spoil",
    [
        lambda v: v | {"version": 99},
        lambda v: {k: x for k, x in v.items() if k != "case"},
        lambda v: v | {"more": 1},
        lambda v: [v],
    ],
)
def test_a_record_of_another_kind_is_refused(tmp_path: Path, spoil: Any) -> None:
    path = write_record(invented(PLAN[0]), tmp_path)
    path.write_text(json.dumps(spoil(json.loads(path.read_text()))))
    with pytest.raises(ParseError):
        read_record(path)


def test_a_record_of_another_plan_is_refused(tmp_path: Path) -> None:
    write_record(invented(PLAN[0]), tmp_path)
    other = dataclasses.replace(PLAN[0], arguments=("--iterations", "20"))
    assert list(read_records(PLAN, tmp_path)) == [PLAN[0].identity]
    with pytest.raises(ParseError, match="other settings"):
        read_records([other], tmp_path)


def test_runs_with_a_record_are_not_made_again(records: Path) -> None:
    first = Maker(records)
    assert carry_out(PLAN, threads=1, runs=3, maker=first) == 0
    assert first.made == [case.identity for case in PLAN[:3]]
    second = Maker(records)
    assert carry_out(PLAN, threads=1, maker=second) == 0
    assert second.made == [case.identity for case in PLAN[3:]]
    third = Maker(records)
    carry_out(PLAN, threads=1, maker=third)
    assert third.made == []
    carry_out(PLAN[:1], threads=1, again=True, maker=third)
    assert third.made == [PLAN[0].identity]


def test_a_run_that_fails_is_counted_and_made_again_the_next_time(records: Path) -> None:
    broken = PLAN[1].identity
    assert carry_out(PLAN, threads=1, maker=Maker(records, (broken,))) == 1
    assert not record_path(PLAN[1], records).exists()
    again = Maker(records)
    assert carry_out(PLAN, threads=1, maker=again) == 0
    assert again.made == [broken]


def test_the_document_alone_makes_no_run(records: Path, tmp_path: Path) -> None:
    maker, written = Maker(records), list[list[str]]()

    def write(out: Path, found: Any, cases: Any) -> Path:
        written.append(list(found))
        return out

    arguments = ["--document", "--out", str(tmp_path)]
    assert study.run_study(arguments, "", PLAN, write, maker) == 1  # no record yet
    write_record(invented(PLAN[2]), records)
    assert study.run_study(arguments, "", PLAN, write, maker) == 0
    assert (maker.made, written) == ([], [[PLAN[2].identity]])
    assert study.run_study(["--only", "spot", "seed1"], "", PLAN, write, maker) == 0
    assert maker.made == ["spot-one-seed1", "spot-two-seed1"]
    assert written[-1] == ["spot-one-seed0", "spot-one-seed1", "spot-two-seed1"]


def test_words_of_one_kind_are_alternatives() -> None:
    assert named(PLAN, []) == PLAN
    assert [c.identity for c in named(PLAN, ["wheel", "two"])] == [
        "wheel-two-seed0", "wheel-two-seed1",
    ]  # fmt: skip
    assert named(PLAN, ["wheel", "spot", "seed0"]) == PLAN[:4]
    with pytest.raises(UsageError, match="wheal"):
        named(PLAN, ["wheal"])


def test_options_are_pairs() -> None:
    assert options(("--a", "1", "--b", "x")) == {"--a": "1", "--b": "x"}
    for wrong in (("--a",), ("a", "1")):
        with pytest.raises(ValueError, match="pairs"):
            options(wrong)


def test_spread_is_that_of_a_sample() -> None:
    values = [0.91, 0.94, 0.98]
    found = Spread.of(values)
    assert found is not None
    assert found.mean == pytest.approx(statistics.fmean(values))
    assert found.deviation == pytest.approx(statistics.stdev(values))
    assert found.error == pytest.approx(statistics.stdev(values) / 3**0.5)
    assert shown([1.0, 2.0, None, 3.0], 2) == "2.00 ± 1.00"
    assert shown([1.0], 3) == "1.000"
    assert shown([None], 3) is None


def test_a_difference_is_clear_from_two_standard_errors_on() -> None:
    assert Spread(0.021, 0.02, 4).clear
    assert not Spread(0.019, 0.02, 4).clear
    assert Spread(-0.021, 0.02, 4).clear
    assert not Spread(5.0, None, 1).clear
    assert Spread(0.5, None, 1).text(2, signed=True) == "+0.50"


def test_mixed_versions_are_said() -> None:
    one = [invented(case) for case in PLAN[:3]]
    assert said_versions(one) == "All runs are of one version of the code (commit 0123456789)."
    # Another commit of the same code is no other version.
    same = invented(PLAN[3], code=dataclasses.replace(CODE, commit="9999999999"))
    assert "one version" in said_versions([*one, same])
    other = invented(
        PLAN[3], code=dataclasses.replace(CODE, core="bbbbbbbbbb", commit="7777777777")
    )
    said = said_versions([*one, other])
    assert "2 versions of the code are mixed" in said
    assert "3 of 0123456789, 1 of 7777777777" in said
    assert "does not say that their results are the same" in said
    raised = dataclasses.replace(other.code, stages={"train": 6, "mesh": 10})
    said = said_versions([*one, dataclasses.replace(other, code=raised)])
    assert "the result of mesh was changed on purpose" in said
    changed = dataclasses.replace(CODE, changed=True)
    assert "with uncommitted changes" in said_versions([invented(PLAN[0], code=changed)])


def test_the_origin_says_what_is_missing() -> None:
    found = [invented(case) for case in PLAN[:2]]
    words = " ".join(made_by("the command", found, PLAN))
    for part in ("`the command`", "2026-01-02", "a processor, 1 thread a run", "6 of 8 planned"):
        assert part in words
    assert "All planned runs are there." in " ".join(made_by("c", found, PLAN[:2]))


def test_the_code_of_the_tree_is_found() -> None:
    code = code_of_tree()
    if (ROOT / ".git").exists():
        assert len(code.commit) == len(code.core) == 10
    else:
        assert code.commit == code.core == "unknown"
    assert code.stages == STAGE_VERSIONS


def test_lengths_are_kept_as_shares_of_the_diagonal() -> None:
    scores = {
        "diagonal": 2.0,
        "surface": {"uniform": surface(0.7), "scan": surface(0.8), "legacy": surface(0.5)},
        "texture": {"psnr": 24.123456789, "views": [1, 2]},
        "gaussians": {"count": 7},
        "depths": {"start": {"within": [0.1, 0.2, 0.3]}},
    }
    kept = kept_scores(scores)
    assert set(kept["surface"]) == {"uniform", "scan"}
    assert kept["surface"]["uniform"]["chamfer_mean"] == pytest.approx(0.002)
    assert kept["surface"]["uniform"]["f1"] == [0.7, 0.701, 0.702]
    assert kept["texture"] == {"psnr": 24.1235, "ssim": None, "coverage": None}
    assert kept["gaussians"] == {"count": 7}
    assert kept["depths"] == {"start": {"within": [0.1, 0.2, 0.3]}}
    assert "depth" not in kept


def test_mesh_based_rendering_is_filled_into_records_of_kept_meshes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root, kept = tmp_path / "records", tmp_path / "kept"
    known = invented(PLAN[0], mbr={"psnr": 20.0})
    for made in (known, invented(PLAN[1]), invented(PLAN[2])):
        write_record(made, root)
    for case in PLAN[:2]:
        (study.run_folder(case, kept) / "mesh").mkdir(parents=True)  # of the third none is kept
    asked: list[list[str]] = []

    def judged(module: str, arguments: list[str], path: Path, settings: Any) -> dict[str, Any]:
        asked.append([module, *arguments])
        return {"psnr": 21.123456789, "uncovered": 0.25, "views": [1, 2], "settings": {}}

    monkeypatch.setattr(study, "judged_by", judged)
    monkeypatch.setattr(study, "ensure_scene", lambda name, **_: tmp_path / name)
    assert study.fill_in(PLAN, threads=1, kept=kept, root=root) == 0
    folder = study.run_folder(PLAN[1], kept)
    assert [a[0] for a in asked] == ["benchmarks.mesh_based"]
    assert {str(folder / "mesh"), str(folder / "out")} < set(asked[0])
    found = read_records(PLAN, root)
    assert found[PLAN[0].identity] == known
    assert found[PLAN[2].identity].mbr is None
    filled = found[PLAN[1].identity]
    assert filled.mbr is not None
    assert (filled.mbr["psnr"], filled.mbr["uncovered"]) == (21.1235, 0.25)
    assert "views" not in filled.mbr
    assert dataclasses.replace(filled, mbr=None) == invented(PLAN[1])
    # Nothing is left to do but what is asked for again.
    study.fill_in(PLAN, threads=1, kept=kept, root=root)
    assert len(asked) == 1
    study.fill_in(PLAN, threads=1, again=True, runs=1, kept=kept, root=root)
    assert len(asked) == 2


def test_runs_that_warm_up_at_once_do_not_share_a_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folders: list[Path] = []

    def wrap(run: Run, scene: Path, settings: Settings) -> Path:
        folders.append(settings.folder)
        if len(folders) == 1:
            warm_up(scene, Settings(tmp_path / "kept", 1, False))
        assert settings.folder.is_dir()
        return scene

    monkeypatch.setattr(runs, "run_wrap", wrap)
    warm_up(tmp_path, Settings(tmp_path / "kept", 1, False))
    assert len(set(folders)) == 2
    assert list((tmp_path / "kept").iterdir()) == []
