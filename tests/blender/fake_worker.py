# SPDX-License-Identifier: GPL-3.0-or-later
"""A worker that obeys the job folder protocol without torch; ``GW_FAKE`` says how it behaves.

Run as ``PYTHON ... jobs.worker FOLDER 1`` in place of the worker's Python,
or as ``... jobs.estimate REQUEST``, which answers ``GW_ANSWER``.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from gaussian_wrapping_addon.core.gaussians.preview_points import POINT, POINTS_FILE, points_file
from gaussian_wrapping_addon.core.jobs.store.job_file import read_job
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder, JobStatus
from gaussian_wrapping_addon.core.worker.spawn import Caller, process_start_ticks
from tests.blender.synthetic_result import npy_bytes, write_region_result, write_result

LIVE = {
    "iteration": 750.0,
    "iterations": 3000.0,
    "gaussians": 12345.0,
    "psnr": 25.04,
    "held_out_psnr": 24.31,
    "iterations_per_s": 16.25,
}


def picture() -> np.ndarray:
    """Return a photo beside a rendering, as a training's preview shows them."""
    y, x = np.mgrid[0:120, 0:160]
    disc = np.hypot(x - 80, y - 60) < 45
    photo = np.where(disc[..., None], (220, 120, 40), (90, 110, 130)).astype(np.uint8)
    return np.concatenate([photo, np.zeros((120, 4, 3), np.uint8), photo // 8 * 7], axis=1)


def ball_points() -> np.ndarray:
    """Return the points of a ball of radius 1, coloured by their place."""
    ball = np.random.default_rng(0).normal(size=(20_000, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    points = np.zeros(len(ball), POINT)
    points["position"] = ball
    points["color"] = 255
    points["color"][:, :3] = 127.5 * (1.0 + ball)
    return points


def main() -> int:
    if sys.argv[-2] == "jobs.commands.estimate_command":
        return estimate()
    folder = JobFolder(Path(sys.argv[-2]))
    caller = Caller() if sys.argv[-1] != "0" else None
    mode = os.environ.get("GW_FAKE", "quick")

    def say(state: str, fraction: float, **more: object) -> None:
        folder.write_status(
            JobStatus(
                state=state,
                stage=os.environ.get("GW_FAKE_STAGE", "train"),
                fraction=fraction,
                message="step",
                seconds_left=(1.0 - fraction) * 90.0,
                pid=os.getpid(),
                pid_started=process_start_ticks(os.getpid()),
                heartbeat_s=time.time(),
                figures=LIVE,
                **more,  # type: ignore[arg-type]
            )
        )

    folder.lock()
    if mode == "hang":
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
    say("RUNNING", 0.25)
    if mode == "crash":
        print("the fake has crashed")
        os.abort()
    if mode == "refuse":
        say("FAILED", 0.25, error="There are no photos.", hint="Choose another folder.")
        return 3
    if mode == "hang":
        time.sleep(60)
    if mode == "slow":
        trained = folder.stages / "train-now"
        trained.mkdir(exist_ok=True)
        (trained / "preview-training.npy").write_bytes(npy_bytes(picture()))
        (trained / POINTS_FILE).write_bytes(points_file(ball_points()))
    while mode == "slow":
        time.sleep(0.02)
        if not folder.root.is_dir():
            return 1  # as the real worker, which cannot write its status
        # As the real worker: it does not outlive its caller, unless it was told to.
        if folder.cancel_path.exists() or (caller and caller.ended()):
            say("CANCELLED", 0.25, hint="Resume continues from the last checkpoint.")
            folder.unlock()
            return 5
        if (folder.root / "finish").exists():
            break
    job = read_job(folder.job_path)
    if job.command in ("wrap", "more"):
        write_result(folder.root)
        trained = folder.stages / f"train-abc{job.settings.training.extra_iterations}"
        trained.mkdir(exist_ok=True)
        (trained / "done.json").write_text(json.dumps({"seconds": 1.0}))
    for body in job.region_bodies.values():
        name = body["blender_object_name"].replace(" ", "_").replace(".", "_")
        write_region_result(folder.result / name, half=0.3)
    say("DONE", 1.0, result=str(folder.result), exit_code=0)
    folder.unlock()
    return 0


def estimate() -> int:
    """Answer as the worker's estimate does."""
    asked = json.loads(sys.argv[-1])
    Path(os.environ["GW_ASKED"]).write_text(json.dumps(asked))
    print(os.environ["GW_ANSWER"])
    return 0


if __name__ == "__main__":
    sys.exit(main())
