# SPDX-License-Identifier: GPL-3.0-or-later
"""Walk the parts of a finished training's mesh in this process, without texture and export."""

from __future__ import annotations

import dataclasses

from gaussian_wrapping_addon.core.devices import DeviceChoice
from gaussian_wrapping_addon.core.jobs.parts.graph import Part, read_state
from gaussian_wrapping_addon.core.jobs.parts.runner import InProcess, PartResult, PartRunner, Walk
from gaussian_wrapping_addon.core.jobs.store.job_file import JobFile
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder
from gaussian_wrapping_addon.core.jobs.store.stage_folder import Stage, read_done
from gaussian_wrapping_addon.core.progress import Progress


class MeshRunner(PartRunner):
    """Runs the parts of the mesh; keeps which ones were finished before."""

    reused: dict[str, bool]

    def run(self, part: Part, progress: Progress) -> PartResult:
        """Run a part; texture and export make nothing."""
        if part.kind in ("texture", "export"):
            return PartResult(())
        result = super().run(part, progress)
        self.__dict__.setdefault("reused", {})[part.name] = result.reused
        return result


def walk_mesh(folder: JobFolder, job: JobFile, name: str, device: DeviceChoice) -> Stage:
    """Mesh the only region of a job and return its stage."""
    runner = MeshRunner(folder, job, lambda: walk.graph, threads=1, device=device, begun_s=0.0)
    engine = InProcess(folder.root, runner, lambda part: Progress())
    walk = Walk(folder, job, engine, engine, lambda *_: None, lambda: False)
    walk.run()
    state = read_state(folder.root, f"mesh-{name}")
    assert state is not None
    stage = folder.root / state.outputs[0]
    done = read_done(stage)
    assert done is not None
    made = Stage(f"mesh-{name}", stage.name.rpartition("-")[2], stage, done, False)
    return dataclasses.replace(made, reused=runner.reused[f"plan-{name}"])
