# SPDX-License-Identifier: GPL-3.0-or-later
"""Several processes share the tasks of a mesh and take over those of a dead process."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from gaussian_wrapping_addon.core.errors import MeshingError, ParseError
from gaussian_wrapping_addon.core.jobs.store import claims as claims_module
from gaussian_wrapping_addon.core.jobs.store.claims import (
    Claims,
    Task,
    host_and_pid_namespace,
    run_tasks,
)
from gaussian_wrapping_addon.core.meshing.tiles.plan import Field
from gaussian_wrapping_addon.core.meshing.tiles.store import (
    faces_path,
    gathered_path,
    load_faces,
    load_gathered,
    load_plan,
    save_plan,
)
from gaussian_wrapping_addon.core.meshing.tiles.tiled_mesh import join_tiles, plan_tiles
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.settings import MeshingSettings
from tests.core.jobs.tile_process import torus_tasks
from tests.core.meshing.meshing_scenes import (
    ShapeField,
    assert_closed_manifold,
    cube,
    gaussians_on,
    some_cameras,
    torus,
)
from tests.core.meshing.tiled_meshing import mesh_in_tiles

ROOT = Path(__file__).resolve().parents[4]
SETTINGS = MeshingSettings(points=1200, spacing="uniform")


def claim_of(folder: Path, name: str, **changes: object) -> Path:
    path = folder / f"{name}.json"
    values = {
        "place": host_and_pid_namespace(),
        "pid": 2**22 + 5,
        "started": 1,
        "token": "t",
        **changes,
    }
    path.write_text(json.dumps(values))
    return path


def test_a_claim_is_held_by_one_and_given_back(tmp_path: Path) -> None:
    first, second = Claims(tmp_path / "c"), Claims(tmp_path / "c")
    with first.held("a") as free:
        assert free
        with second.held("a") as also:
            assert not also
        with second.held("b") as other:
            assert other
    assert not list((tmp_path / "c").iterdir())
    with second.held("a") as free:
        assert free


def test_a_claim_is_given_back_after_an_error(tmp_path: Path) -> None:
    claims = Claims(tmp_path / "c")
    with pytest.raises(MeshingError), claims.held("a"):
        raise MeshingError("no")
    assert not claims.path("a").exists()


def test_the_claim_of_a_dead_process_is_taken_at_once(tmp_path: Path) -> None:
    claims = Claims(tmp_path)
    claim_of(tmp_path, "a")
    with claims.held("a") as free:
        assert free
        assert json.loads(claims.path("a").read_text())["token"] != "t"


@pytest.mark.parametrize("content", [None, "", "{", "[]", '{"pid": "x"}'])
def test_a_foreign_claim_is_left_until_it_is_stale(tmp_path: Path, content: str | None) -> None:
    path = claim_of(tmp_path, "a", place="another machine")
    if content is not None:
        path.write_text(content)
    patient, hasty = Claims(tmp_path, stale_s=1e6), Claims(tmp_path, stale_s=0.0)
    for _ in range(2):
        with patient.held("a") as free:
            assert not free
    with hasty.held("a") as free:
        assert free


def test_a_foreign_claim_that_is_refreshed_lives(tmp_path: Path) -> None:
    path = claim_of(tmp_path, "a", place="another machine")
    claims = Claims(tmp_path, stale_s=0.15)
    for turn in range(4):
        os.utime(path, ns=(turn, turn))
        with claims.held("a") as free:
            assert not free
        time.sleep(0.1)
    time.sleep(0.2)
    with claims.held("a") as free:
        assert free


def test_a_holder_refreshes_its_claim(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(claims_module, "REFRESH_S", 0.02)
    claims = Claims(tmp_path)
    with claims.held("a"):
        before = claims.path("a").stat().st_mtime_ns
        limit_s = time.monotonic() + 10
        while claims.path("a").stat().st_mtime_ns == before:
            assert time.monotonic() < limit_s
            time.sleep(0.02)


def test_tasks_run_in_order_of_need_and_errors_pass(tmp_path: Path) -> None:
    done: list[str] = []

    def task(name: str, needs: str = "") -> Task:
        return Task(
            name, lambda: name in done, lambda: not needs or needs in done,
            lambda _: done.append(name),
        )  # fmt: skip

    tasks = [task("c", "b"), task("b", "a"), task("a")]
    assert run_tasks(tasks, Claims(tmp_path), Progress()) == 3
    assert done == ["a", "b", "c"]

    def fail(_: Progress) -> None:
        raise MeshingError("this part cannot be made")

    broken = Task("d", lambda: False, lambda: True, fail)
    done_here: list[str] = []
    with pytest.raises(MeshingError):
        run_tasks([task("e"), broken], Claims(tmp_path), Progress(), done_here=done_here)
    assert done_here == ["e"]
    assert not list(tmp_path.glob("*.json"))
    assert Claims(tmp_path).worker_count() == 2


def test_two_processes_do_not_take_over_the_same_claim(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    claim_of(tmp_path, "a")  # of a dead process
    first, second = Claims(tmp_path), Claims(tmp_path)
    whole = Claims._owner
    held = first.held("a")
    taken = []

    def look_and_wait(path: Path) -> dict:
        owner = whole(path)
        if not taken:
            taken.append(None)  # from here on first looks, too, and takes over
            taken[0] = held.__enter__()
        return owner

    monkeypatch.setattr(Claims, "_owner", staticmethod(look_and_wait))
    with second.held("a") as also:
        assert not also
    assert taken == [True]
    assert (tmp_path / "a.json").is_file()
    held.__exit__(None, None, None)
    assert not list(tmp_path.iterdir())


def planned(folder: Path) -> Field:
    shape = ShapeField(torus(), 0.02)
    field = Field(shape, shape, 1)
    arrays = gaussians_on(torus(), cube(1.5), 800, 0.02)
    plan = plan_tiles(
        field, arrays, some_cameras(), cube(1.5), SETTINGS, Progress(), tiles=4, seed=0
    )
    save_plan(folder, plan, {"cameras": "c", "training": "t"})
    return field


def start(folder: Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "tests.core.jobs.tile_process", str(folder)],
        cwd=ROOT, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip


def test_two_processes_and_a_killed_one_give_the_mesh_of_one(tmp_path: Path) -> None:
    folder = tmp_path / "tiles"
    field = planned(folder)
    killed = start(folder)
    limit_s = time.monotonic() + 120
    while not list(folder.glob("claims/*.json")):
        assert time.monotonic() < limit_s
        assert killed.poll() is None
        time.sleep(0.002)
    killed.kill()
    killed.wait()
    worker_count = [start(folder), start(folder)]
    shares = [int(worker.communicate(timeout=200)[0]) for worker in worker_count]
    assert all(task.done() for task in torus_tasks(folder))
    assert not list(folder.glob("claims/*.json"))
    assert 1 <= sum(shares) <= 9
    known = Claims(folder / "claims").worker_count()
    at_work = sum(share > 0 for share in shares)
    assert at_work <= known <= at_work + 1, "one that was killed may have done a part"
    plan, origin = load_plan(folder)
    assert origin == {"cameras": "c", "training": "t"}
    parts = [load_faces(faces_path(folder, tile)) for tile in range(4)]
    everything = load_gathered(gathered_path(folder))
    mesh = join_tiles(field, plan, everything, parts, SETTINGS, Progress())
    figures = assert_closed_manifold(mesh)
    assert (figures.components, figures.genus) == (1, 1)
    alone = mesh_in_tiles(
        field.vacancy, field.vectors, gaussians_on(torus(), cube(1.5), 800, 0.02), some_cameras(),
        cube(1.5), SETTINGS, Progress(), tiles=4, seed=0, threads=1,
    )  # fmt: skip
    assert (alone.faces == mesh.faces).all()
    assert np.array_equal(alone.vertices, mesh.vertices)


def test_a_list_of_another_version_or_broken_is_told(tmp_path: Path) -> None:
    planned(tmp_path / "tiles")
    path = tmp_path / "tiles" / "tiles.json"
    values = json.loads(path.read_text())
    path.write_text(json.dumps({**values, "version": 2}))
    with pytest.raises(ParseError, match="version"):
        load_plan(tmp_path / "tiles")
    del values["splits"]
    path.write_text(json.dumps(values))
    with pytest.raises(ParseError, match=r"tiles\.json"):
        load_plan(tmp_path / "tiles")
