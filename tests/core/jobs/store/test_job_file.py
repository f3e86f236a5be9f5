# SPDX-License-Identifier: GPL-3.0-or-later
"""Job files: round trip and validation."""

from __future__ import annotations

import json
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from gaussian_wrapping_addon.core.errors import EXIT_BAD_DATA, DatasetError, ParseError, UsageError
from gaussian_wrapping_addon.core.jobs.client import JobClient
from gaussian_wrapping_addon.core.jobs.commands import estimate_mesh_command, run_in_worker
from gaussian_wrapping_addon.core.jobs.stages.cameras import _units_key, run_cameras
from gaussian_wrapping_addon.core.jobs.store.job_file import (
    JobFile,
    make_job,
    read_job,
    reject_folder_conflicts,
    reject_region_conflicts,
    training_keys,
    write_job,
)
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder
from gaussian_wrapping_addon.core.jobs.store.stage_folder import stage_key
from gaussian_wrapping_addon.core.loading.real_world import UnitsRequest
from gaussian_wrapping_addon.core.names import JOB_MARKER, region_name, region_names
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.settings import JobSettings, MeshingSettings, preset


def body_of(name: str, size: float = 1.0) -> dict[str, Any]:
    return {
        "class_name": "GaussianWrappingBoundingVolume", "version": 1, "blender_object_name": name,
        "vertices": [[0, 0, 0], [size, 0, 0], [0, size, 0], [0, 0, size]], "hull_simplices": None,
    }  # fmt: skip


def region_file(path: Path, name: str, size: float = 1.0) -> str:
    path.write_text(json.dumps(body_of(name, size)))
    return str(path)


def test_round_trip_keeps_settings_region_content_and_own_lengths(tmp_path: Path) -> None:
    region_file(tmp_path / "head.json", "head")
    head = str(tmp_path / ".." / tmp_path.name / "head.json")
    settings = preset("fine", regions=("auto", head), export=("glb", "ply"), seed=7)
    settings = replace(settings, meshing=MeshingSettings(points=5000))
    assert "edge_lengths" not in make_job("wrap", tmp_path, settings).to_json()
    job = make_job("wrap", tmp_path, settings, {head: 0.25})
    write_job(tmp_path / "job.json", job)
    (tmp_path / "head.json").unlink()
    again = read_job(tmp_path / "job.json")
    assert again == job
    (_, name) = again.settings.regions
    assert again.region_bodies[name] == body_of("head"), "the file keeps to version 1"
    assert again.meshing_of(name) == replace(settings.meshing, edge_length=0.25, points=0)
    assert again.meshing_of("auto") == settings.meshing


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"schema_version": 99}, "schema version"),
        ({"command": "erase"}, "command"),
        ({"extra": 1}, "entries"),
        ({"settings": {"preset": "draft", "colour": 1}}, "colour"),
        ({"settings": {"training": {"iterations": "many"}}}, "iterations"),
        ({"settings": {"training": {"iterations": True}}}, "iterations"),
        ({"settings": {"meshing": {"edge_length": -1.0}}}, "edge_length"),
        ({"settings": []}, "object"),
    ],
)
def test_what_is_not_a_job_is_refused_by_name(tmp_path: Path, change: dict, word: str) -> None:
    values = make_job("wrap", tmp_path, JobSettings()).to_json()
    values.update(change)
    with pytest.raises(UsageError, match=word):
        JobFile.from_json(json.loads(json.dumps(values)))


def test_half_a_job_file_names_the_line_and_a_missing_source_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "job.json"
    path.write_text('{"schema_version": 1,\n "command": ')
    with pytest.raises(ParseError, match="line 2"):
        read_job(path)
    with pytest.raises(DatasetError, match="does not exist"):
        make_job("wrap", tmp_path / "nothing", JobSettings())


@pytest.mark.parametrize(
    ("request_", "name", "folder"),
    [
        ("auto", None, "auto"),
        ("x/Left hand.json", None, "Left_hand"),
        ("x/a.json", "Région 1/2", "R_gion_1_2"),
        ("x/a.json", "../../etc", "etc"),
        ("x/a.json", "Report", "region_Report"),
        ("x/a.json", "reports", "reports"),
        ("x/a.json", "com1", "region_com1"),
        # The number is the one of 0.1.0, so that a region meshed again finds its folder.
        ("x/\u4e2d.json", None, "region_" + stage_key("x/\u4e2d.json")[:6]),
    ],
)
def test_region_names_are_safe_folder_names_that_nothing_else_has(
    request_: str, name: str | None, folder: str
) -> None:
    assert region_name(request_, {"blender_object_name": name} if name else {}) == folder
    assert region_name("x/auto.json", {}) not in ("auto", "all", "")


def test_names_of_one_folder_are_both_told() -> None:
    with pytest.raises(UsageError, match="same name"):
        region_names(["x/Head.json", "x/head.json"], {})
    assert region_names(["x/Head.json", "x/Heads.json"], {}) == ["Head", "Heads"]
    requests = ["x/a b.json", "x/auto.json", "x/a_b.json"]
    with pytest.raises(UsageError, match="a_b: 'a b' and 'a_b' use the same folder"):
        region_names(requests, {})
    assert region_names(requests[:2], {})[0] == "a_b"


def test_a_job_that_would_replace_another_result_never_starts(tmp_path: Path) -> None:
    """Panel and command line start jobs by this client: no worker has to be asked."""
    job, photos = tmp_path / "job", tmp_path / "photos"
    photos.mkdir()
    (job / "result" / "a_b").mkdir(parents=True)
    (job / JOB_MARKER).touch()
    (job / "result" / "a_b" / "region.json").write_text('{"blender_object_name": "a_b"}')
    requests = [
        make_job("mesh", photos, JobSettings(regions=(region_file(tmp_path / "r.json", name),)))
        for name in ("a b", "a_b")
    ]
    with pytest.raises(UsageError, match="'a b' would replace the result of region 'a_b'"):
        JobClient.start(job, requests[0], python="none")
    assert not (job / "job.json").exists()
    reject_region_conflicts(job / "result", requests[1])


@pytest.mark.parametrize(("new", "refused"), [("Würfel", False), ("Wörfel", True), ("w", False)])
def test_a_region_does_not_replace_the_result_of_another(
    new: str, refused: bool, tmp_path: Path
) -> None:
    (tmp_path / "W_rfel").mkdir()
    (tmp_path / "W_rfel" / "region.json").write_text('{"blender_object_name": "Würfel"}')
    folder = region_name("r.json", {"blender_object_name": new})
    with pytest.raises(UsageError, match="Würfel") if refused else nullcontext():
        reject_folder_conflicts(tmp_path, {"auto": "auto", new: folder})


def test_regions_that_a_training_favours_stay_its_own(tmp_path: Path) -> None:
    """Another region is meshed from the same training: the training's key must not change."""
    head = region_file(tmp_path / "head.json", "head")
    foot = region_file(tmp_path / "foot.json", "foot", 2.0)
    settings = preset("draft", regions=(head,))
    evenly = replace(settings, training=replace(settings.training, region_weight=1.0))
    assert make_job("wrap", tmp_path, evenly).settings.training.focus == ""
    everything = replace(settings, regions=(*settings.regions, "all"))
    assert make_job("wrap", tmp_path, everything).settings.training.focus == ""
    both = make_job("wrap", tmp_path, replace(settings, regions=("auto", *settings.regions)))
    shape = {name: body_of("head")[name] for name in ("class_name", "version", "vertices")}
    assert json.loads(both.settings.training.focus) == [shape, "auto"]
    assert JobFile.from_json(both.to_json()) == both
    trained = make_job("wrap", tmp_path, settings)
    assert json.loads(trained.settings.training.focus) == [shape]
    other = replace(trained.settings, regions=(foot,))
    meshed = make_job("mesh", tmp_path, other)
    assert meshed.settings.training == trained.settings.training
    assert training_keys("cameras", meshed) == training_keys("cameras", trained)
    again = make_job("wrap", tmp_path, other)
    assert training_keys("cameras", again) != training_keys("cameras", trained)
    # Names and order are no reason to train again.
    renamed = region_file(tmp_path / "nose.json", "nose")
    pairs = [
        make_job("wrap", tmp_path, replace(settings, regions=regions))
        for regions in ((head, foot), (foot, renamed))
    ]
    assert len({tuple(training_keys("cameras", job)) for job in pairs}) == 1


@pytest.mark.parametrize(
    ("region", "message"), [("none.json", "does not exist"), (".", "is a folder, not")]
)
def test_a_region_that_is_no_file_is_told_by_all_commands(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch,
    region: str, message: str,
) -> None:  # fmt: skip
    monkeypatch.setattr(run_in_worker, "exit_with_caller", lambda _caller: None)
    path = str(tmp_path / region)
    with pytest.raises(DatasetError, match=message):
        make_job("mesh", tmp_path, JobSettings(regions=(path,)))
    for name in (JOB_MARKER, "job.json"):
        (tmp_path / name).write_text("{}")
    request = {"out": str(tmp_path), "region": path, "threads": 1, "meshing": {}}
    assert estimate_mesh_command.main([json.dumps(request)]) == EXIT_BAD_DATA
    assert message in json.loads(capsys.readouterr().out)["error"]


def test_two_regions_of_one_name_are_refused_before_anything_starts(tmp_path: Path) -> None:
    names = {"a": "head", "b": "head", "c": "foot"}
    a, b, c = (region_file(tmp_path / f"{file}.json", name) for file, name in names.items())
    with pytest.raises(UsageError, match="same name, head"):
        make_job("mesh", tmp_path, JobSettings(regions=(a, "auto", b)))
    # One file by two spellings is one region.
    again = f"{tmp_path}/../{tmp_path.name}/a.json"
    job = make_job("mesh", tmp_path, JobSettings(regions=(a, c, again)))
    assert job.settings.regions == (a, c)


@pytest.mark.parametrize(
    "lengths",
    [*({"auto": one} for one in (0.0, 1e-320, float("nan"), "1", True)), {"nobody": 1.0}, [1.0]],
)
def test_impossible_lengths_are_refused(tmp_path: Path, lengths: object) -> None:
    values = {**make_job("mesh", tmp_path, JobSettings()).to_json(), "edge_lengths": lengths}
    with pytest.raises(UsageError, match="edge_lengths"):
        JobFile.from_json(values)
    if isinstance(lengths, dict):
        with pytest.raises(UsageError, match="edge_lengths"):
            make_job("mesh", tmp_path, JobSettings(), lengths)


def test_metres_in_a_job(tmp_path: Path) -> None:
    points, splat = tmp_path / "gcp.txt", tmp_path / "a.ply"
    points.write_text("LOCAL\n")
    splat.write_bytes(b"ply\n")
    plain = preset("draft")
    settings = replace(plain, markers="4x4_50:0.05", control_points=str(points))
    job = make_job("wrap", tmp_path, settings)
    assert JobFile.from_json(job.to_json()) == job
    assert job.settings.control_points == str(points)
    with pytest.raises(DatasetError, match=r"control points .* do not exist"):
        make_job("wrap", tmp_path, replace(plain, control_points=str(tmp_path / "none")))
    make_job("mesh", tmp_path, replace(plain, control_points=str(tmp_path / "none")))
    for wrong in ("4x4_50", "5:0.1", "4x4_50:0"):
        with pytest.raises(UsageError, match=r"markers is out of range. Give .*4x4_50:0.05"):
            make_job("wrap", tmp_path, replace(plain, markers=wrong))
    started = replace(plain, start_splat=str(splat))
    assert make_job("wrap", tmp_path, started).settings.start_splat == str(splat)
    for change in ({"markers": "4x4_50:1"}, {"georeference": "on"}):
        with pytest.raises(UsageError, match="A splat to start from lies in the frame"):
            make_job("wrap", tmp_path, replace(started, **change))


def test_metres_in_the_key_of_the_cameras(tmp_path: Path) -> None:
    points = tmp_path / "gcp.txt"
    assert _units_key(UnitsRequest()) == []
    keys = [
        _units_key(UnitsRequest(georeference="off")),
        _units_key(UnitsRequest(markers="4x4_50:0.05")),
        _units_key(UnitsRequest(control_points=str(points))),
    ]
    points.write_text("LOCAL\n")
    keys.append(_units_key(UnitsRequest(control_points=str(points))))
    points.write_text("EPSG:4326\n")
    keys.append(_units_key(UnitsRequest(control_points=str(points))))
    assert len({tuple(key) for key in keys}) == 5


def test_a_splat_has_nothing_to_tell_its_size_by(tmp_path: Path) -> None:
    source = tmp_path / "a.ply"
    source.write_bytes(b"ply\n")
    folder = JobFolder(tmp_path / "job")
    folder.stages.mkdir(parents=True)
    job = JobFile("wrap", str(source), replace(preset("draft"), markers="4x4_50:0.05"))
    with pytest.raises(UsageError, match="A splat has no photos to tell its size by"):
        run_cameras(folder, job, Progress(), threads=1)
