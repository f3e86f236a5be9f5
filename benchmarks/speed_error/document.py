# SPDX-License-Identifier: GPL-3.0-or-later
"""The report as Markdown, written from records alone."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from gaussian_wrapping_addon.core.files import write_bytes

from ..study.case import PHOTOS, Case
from ..study.origin import made_by, photos_said, reading
from .cases import SCENES
from .plots import write_plot
from .preset_tables import Records, mesher_table, preset_table

PAGE, PLOT, READING = "README.md", "speed-vs-error.svg", "reading.md"
COMMAND = "python -m benchmarks.speed_vs_error"


def write_document(out: Path, records: Records, cases: Sequence[Case]) -> Path:
    """Write page and plot into a folder; reading and pictures lie beside them."""
    write_plot(records, out / PLOT)
    tables = (preset_table(records), mesher_table(records))
    lines = [
        "# Speed against error",
        "",
        *made_by(COMMAND, list(records.values()), cases),
        "",
        photos_said(PHOTOS),
        "Presets as they are (Draft trains at 480 pixels, the others at 640), the model selected",
        "from the photos, every 8th photo held out; seed 0.",
        "",
        f"![Processor seconds against error]({PLOT})",
        "",
        *reading(out / READING),
        *(table.markdown() for table in tables[:1] if table.rows),
        *_pictures(out),
        *(table.markdown() for table in tables[1:] if table.rows),
        _words("elsewhere"),
        _words("protocol"),
        _words("other_measurements"),
    ]
    path = out / PAGE
    write_bytes(path, ("\n".join(lines).rstrip() + "\n").encode())
    return path


def picture(scene: str) -> str:
    """Return the name of the picture of a scene."""
    return f"scene-{scene}.jpg"


def _pictures(out: Path) -> list[str]:
    """Return the pictures that were drawn, with what they show."""
    names = {scene: picture(scene) for scene in SCENES if (out / picture(scene)).is_file()}
    if not names:
        return []
    return [
        "### What it looks like",
        "",
        "Above: a test photo and the textured meshes. Below: the true surface, and the meshes",
        "coloured by the distance of each face's centre to it: blue within 0.25 % of the diagonal,",
        "green within 0.5 %, yellow within 1 %, red beyond; grey is not judged.",
        "",
        *(line for scene, name in names.items() for line in (f"![{scene}]({name})", "")),
    ]


def _words(name: str) -> str:
    """Return prose that does not depend on figures, with its heading."""
    return Path(__file__).with_name(f"{name}.md").read_text(encoding="utf-8").strip() + "\n"
