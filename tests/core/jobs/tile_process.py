# SPDX-License-Identifier: GPL-3.0-or-later
"""A process that works on the tile list of a torus: ``python -m ... FOLDER``."""

from __future__ import annotations

import sys
from pathlib import Path

from gaussian_wrapping_addon.core.jobs.stages.tile_tasks import tile_tasks
from gaussian_wrapping_addon.core.jobs.store.claims import Claims, Task, run_tasks
from gaussian_wrapping_addon.core.meshing.tiles.plan import Field
from gaussian_wrapping_addon.core.meshing.tiles.store import load_plan
from gaussian_wrapping_addon.core.progress import Progress
from tests.core.meshing.meshing_scenes import ShapeField, torus


def torus_tasks(folder: Path) -> list[Task]:
    """Return the tasks of the list in a folder."""
    field = ShapeField(torus(), 0.02)
    return tile_tasks(folder, load_plan(folder)[0], Field(field, field, 1))


if __name__ == "__main__":
    place = Path(sys.argv[1])
    done = run_tasks(torus_tasks(place), Claims(place / "claims"), Progress(), poll_s=0.05)
    sys.stdout.write(f"{done}\n")
