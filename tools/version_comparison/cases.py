# SPDX-License-Identifier: GPL-3.0-or-later
"""The commands that both versions run, one after the other, through the public command line."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Step:
    """One command; ``{in}`` and ``{out}`` stand for the inputs and the folder of all results."""

    arguments: tuple[str, ...]
    exit_code: int = 0
    cancel_in: str = ""
    """Name of the stage in which the job is asked to stop, once it counts iterations."""
    start: str = ""
    """File below ``{out}`` that is copied to ``{out}/start.ply`` before, with a fixed date."""
    figures_in: str = ""
    """Regular expression of printed lines whose numbers are compared."""


@dataclass(frozen=True)
class Case:
    """Commands, and what they write."""

    name: str
    steps: tuple[Step, ...]
    outputs: tuple[str, ...]
    """Folders and files below ``{out}`` that are compared once the last step has ended."""

    @property
    def folder(self) -> str:
        """Name of the folder of its results."""
        return self.name.replace(",", "").replace(" ", "-")


def _words(text: str) -> tuple[str, ...]:
    return tuple(text.split())


def _step(text: str) -> Step:
    """Return a command that ends well and writes no Blender file."""
    return Step(_words(f"{text} --no-blend"))


_COMMON = (
    "--preset draft --threads 2 --preview-every 0 --holdout 5 --texture-size 256 --wrapping off"
)
_TRAINED = f"{_COMMON} --harmonics off"
"""The earlier side tried harmonics and wrapping out; a splat keeps its harmonics on both."""

CASES = (
    Case(
        "everything on, two regions",
        (
            _step(
                f"wrap {{in}}/colmap --out {{out}}/first {_TRAINED} --iterations 300"
                " --max-gaussians 2500 --needs all --region {in}/cut.json {in}/wedge.json"
                " --points 2500 --faces 2000 --smooth 3 --normal-map on --ambient-occlusion"
                " --lods 1 --export glb,obj,ply,usd"
            ),
        ),
        ("first",),
    ),
    Case(
        "evidence decides, pivots, open, occupied",
        (
            _step(
                f"wrap {{in}}/transforms --out {{out}}/evidence {_TRAINED} --iterations 500"
                " --max-gaussians 3000 --needs auto --mask-mode background --region-weight 2"
                " --region {in}/cap.json --method pivots --pivots 9 --boundary open"
                " --unseen occupied --texture-source gaussians --export ply"
            ),
        ),
        ("evidence",),
    ),
    Case(
        "mesh again, uniform, tiles",
        (
            _step(
                "mesh --out {out}/first --threads 2 --region {in}/cap.json --edge-length 0.3"
                " --spacing uniform --tiles 2 --texture-size 256 --max-atlases 2 --export glb,ply"
            ),
        ),
        ("first",),
    ),
    Case(
        "more iterations; cancelled and resumed",
        (
            _step("more --out {out}/evidence --iterations 60"),
            Step(
                _words(
                    f"wrap {{in}}/colmap --out {{out}}/resumed {_TRAINED} --iterations 400"
                    " --max-gaussians 2000 --needs none --harmonics on --sh-degree 3"
                    " --region {in}/cap.json --points 1000 --export obj --no-blend"
                ),
                exit_code=5,
                cancel_in="train",
            ),
            _step("resume {out}/resumed"),
        ),
        ("evidence", "resumed"),
    ),
    Case(
        "a splat as start, a splat alone",
        (
            Step(_words("export {out}/first --out {out}/exported-splat --format splat")),
            Step(
                _words(
                    f"wrap {{in}}/colmap --out {{out}}/started {_COMMON} --iterations 80"
                    " --max-gaussians 3000 --start-splat {out}/start.ply --region {in}/cap.json"
                    " --points 1000 --export ply --no-blend"
                ),
                start="exported-splat/gaussians.splat.ply",
            ),
            _step(
                f"wrap {{in}}/splat.ply --out {{out}}/splat {_COMMON} --iterations 40"
                " --max-image-px 96 --max-gaussians 3000 --region {in}/cap.json --points 1000"
                " --export ply"
            ),
        ),
        ("started", "splat"),
    ),
    Case(
        "photos without cameras",
        (
            _step(
                "wrap {in}/unposed --out {out}/photos --preset draft --threads 1 --preview-every 0"
                " --texture-size 256 --iterations 60 --max-image-px 128 --max-gaussians 1500"
                " --needs none --points 800 --export ply"
            ),
        ),
        ("photos",),
    ),
    Case(
        "export, evaluate, estimate-mesh",
        (
            Step(
                _words(
                    "export {out}/first --out {out}/exported --format glb,obj,ply,splat,usd"
                    " --lods --shading unlit"
                )
            ),
            Step(
                _words(
                    "evaluate {out}/first --region cut --truth {in}/truth.ply --threads 2"
                    " --align icp --samples 20000 --out {out}/evaluation.json"
                )
            ),
            Step(
                _words("estimate-mesh --out {out}/first --region {in}/cut.json --points 2000"),
                figures_in="triangles|tetrahedra",
            ),
            Step(
                _words("estimate-mesh --out {out}/first --method pivots --pivots 2"),
                figures_in="triangles|tetrahedra",
            ),
        ),
        ("exported", "evaluation.json"),
    ),
)
"""In this order: later cases go on from the results of earlier ones."""
