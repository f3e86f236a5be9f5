# SPDX-License-Identifier: GPL-3.0-or-later
"""Impossible resolutions through the real worker."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import NoReturn

import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import ResourceError
from gaussian_wrapping_addon.core.jobs import runner
from gaussian_wrapping_addon.core.jobs.client import JobClient
from gaussian_wrapping_addon.core.jobs.parts import runner as part_runner
from gaussian_wrapping_addon.core.jobs.store.job_file import make_job, read_job
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder
from tests.core.jobs.finished_sphere import write_cube, write_finished_sphere

BATCH = Path(__file__).resolve().parents[3] / "gaussian_wrapping_addon" / "batch.py"


@pytest.fixture(scope="module")
def sphere(tmp_path_factory: pytest.TempPathFactory) -> tuple[JobFolder, Path]:
    root = tmp_path_factory.mktemp("sphere")
    return write_finished_sphere(root), write_cube(root / "box.json")


def batch(command: str, sphere: tuple[JobFolder, Path], *more: str) -> tuple[int, str]:
    folder, box = sphere
    done = subprocess.run(
        [sys.executable, str(BATCH), command, "--out", str(folder.root), "--region", str(box),
         *more, *(["--no-blend"] if command == "mesh" else [])],
        capture_output=True, text=True, check=False, timeout=200,
    )  # fmt: skip
    return done.returncode, done.stdout + done.stderr


@pytest.mark.parametrize("command", ["estimate-mesh", "mesh"])
@pytest.mark.parametrize(
    ("length", "code", "words"),
    [("-1", 2, "Give a positive length"), ("nan", 2, "Give a positive length"),
     ("1e-320", 2, "Give a positive length"), ("1e-7", 4, "too many")],
)  # fmt: skip
def test_impossible_lengths_are_refused_and_nothing_is_left(
    command: str, length: str, code: int, words: str, sphere: tuple[JobFolder, Path]
) -> None:
    folder, _ = sphere
    before = folder.job_path.read_bytes(), sorted(folder.stages.iterdir())
    found, said = batch(command, sphere, f"--edge-length={length}")
    assert found == code, said
    assert words in said
    assert "Traceback" not in said
    assert (folder.job_path.read_bytes(), sorted(folder.stages.iterdir())) == before
    assert folder.read_status().state == "DONE"


@pytest.mark.parametrize("region", ["auto", "box"])
def test_impossible_lengths_are_refused_before_the_training(
    region: str, sphere: tuple[JobFolder, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    def train(*_: object, **__: object) -> NoReturn:
        raise AssertionError("trained for nothing")

    folder, box = sphere
    earlier = read_job(folder.job_path)
    regions = ("auto",) if region == "auto" else (str(box),)
    settings = replace(earlier.settings, regions=regions)
    request = "auto" if region == "auto" else str(box)
    job = make_job("wrap", Path(earlier.source), settings, {request: 1e-8})
    monkeypatch.setattr(part_runner.TrainingStages, "run", train)
    with pytest.raises(ResourceError, match="too many"):
        runner.run_job(folder, job, lambda _: None, lambda: False)


@pytest.mark.proof
def test_no_length_is_the_automatic_one(sphere: tuple[JobFolder, Path]) -> None:
    asked = [batch("estimate-mesh", sphere, *more) for more in ((), ("--edge-length", "0"))]
    counts = [re.search(r"triangles: .*", said).group() for _, said in asked]  # type: ignore[union-attr]
    assert counts[0] == counts[1]


@pytest.mark.proof
def test_a_length_beyond_the_region_is_clamped_and_said(sphere: tuple[JobFolder, Path]) -> None:
    folder, _ = sphere
    words = "was larger than 1/8 of the region's diagonal"
    code, said = batch("estimate-mesh", sphere, "--edge-length", "1e9")
    assert code == 0, said
    assert words in said
    code, said = batch("mesh", sphere, "--edge-length", "1e9")
    assert code == 0, said
    assert words in said
    report = json.loads((folder.result / "report.json").read_text())
    assert any(words in json.dumps(warning) for warning in report["warnings"])


def test_two_regions_of_one_job_each_at_its_own_length(sphere: tuple[JobFolder, Path]) -> None:
    folder, box = sphere
    lengths = {"fine": 0.1, "coarse": 0.25}
    boxes = {name: str(write_cube(box.with_name(f"{name}.json"))) for name in lengths}
    earlier = read_job(folder.job_path)
    meshing = replace(earlier.settings.meshing, edge_length=0.17, spacing="uniform")
    settings = replace(earlier.settings, regions=tuple(boxes.values()), meshing=meshing)
    own = {boxes[name]: length for name, length in lengths.items()}
    job = make_job("mesh", Path(earlier.source), settings, own)
    status = JobClient.start(folder.root, job).wait(200)
    assert status.state == "DONE", status.error
    for name, asked in lengths.items():
        with np.load(folder.result / name / "mesh.npz", allow_pickle=False) as arrays:
            corners = arrays["vertices"][arrays["faces"]]  # (m, 3, 3)
        edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)  # (m, 3)
        assert 0.75 * asked < np.median(edges) < 1.3 * asked, name
