# SPDX-License-Identifier: GPL-3.0-or-later
"""Unusual photos and cameras end in a mesh, or in a typed error that says what is wrong."""

from __future__ import annotations

import json
import math
import struct
import subprocess
import sys
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gaussian_wrapping_addon.core.errors import EXIT_BAD_DATA, DatasetError
from gaussian_wrapping_addon.core.jobs.runner import run_job
from gaussian_wrapping_addon.core.jobs.store.job_file import make_job
from gaussian_wrapping_addon.core.jobs.store.job_folder import JobFolder
from gaussian_wrapping_addon.core.meshing.checks import validate_manifold
from gaussian_wrapping_addon.core.scene.camera import quaternion_from_rotation
from gaussian_wrapping_addon.core.settings import (
    JobSettings,
    MeshingSettings,
    TextureSettings,
    TrainingSettings,
)
from tests.core.readers.model_writers import ImageRecord, Model, write_text
from tests.poses import look_at_pose
from tests.proofs import first_then_proofs
from tests.synthetic import trace

BATCH = Path(__file__).resolve().parents[3] / "gaussian_wrapping_addon" / "batch.py"
WIDTH, HEIGHT, FOCAL_PX = 64, 56, 74.0
Save = Callable[[np.ndarray, Path], None]


def save_png(pixels: np.ndarray, path: Path) -> None:
    Image.fromarray(pixels).save(path)


@dataclass
class Case:
    """Cameras and photos of the ball scene of ``tests.synthetic``, with what makes them hard."""

    poses: list[np.ndarray]
    sizes: list[tuple[int, int]] = field(default_factory=lambda: [(WIDTH, HEIGHT)])
    focal_px: float = FOCAL_PX
    cx_px: float | None = None
    save: Save = save_png
    suffix: str = ".png"
    replaced: dict[int, Save] = field(default_factory=dict)
    """Photos that are saved otherwise."""

    def write(self, folder: Path) -> Path:
        """Write photos and a COLMAP text model."""
        (folder / "images").mkdir(parents=True)
        cameras, records = [], []
        for index, pose in enumerate(self.poses):
            width, height = self.sizes[index % len(self.sizes)]
            cx = width / 2 if self.cx_px is None else self.cx_px
            name = f"{index:03d}{self.suffix}"
            lens = [self.focal_px, self.focal_px, cx, height / 2]
            cameras.append((index + 1, "PINHOLE", width, height, lens))
            quaternion = quaternion_from_rotation(pose[:, :3])
            records.append(ImageRecord(index + 1, quaternion, pose[:, 3], index + 1, name))
            rays = np.ones((height, width, 3))
            rays[..., 0] = (np.arange(width) + 0.5 - cx) / self.focal_px
            rays[..., 1] = ((np.arange(height) + 0.5 - height / 2) / self.focal_px)[:, None]
            center = -pose[:, :3].T @ pose[:, 3]
            color = trace(center, rays.reshape(-1, 3) @ pose[:, :3]).reshape(height, width, 3)
            pixels = np.round(255 * color).astype(np.uint8)
            self.replaced.get(index, self.save)(pixels, folder / "images" / name)
        random = np.random.default_rng(3)
        ball = random.normal(size=(400, 3))
        ball /= np.linalg.norm(ball, axis=1, keepdims=True)
        floor = np.concatenate([random.uniform(-3, 3, (400, 2)), np.full((400, 1), -1.0)], 1)
        cloud = [
            (p.tolist(), [128, 128, 128], 0.5, [(1, 0), (2, 0)])
            for p in np.concatenate([ball, floor])
        ]
        write_text(Model(cameras, records, cloud), folder / "sparse" / "0")
        return folder


def ring(count: int = 10) -> list[np.ndarray]:
    angles = 2 * np.pi * np.arange(count) / count
    return [
        look_at_pose((4 * np.cos(a), 4 * np.sin(a), 3.6 if k % 2 else 2.0), (0.0, 0.0, -0.2))
        for k, a in enumerate(angles)
    ]


def beside(pose: np.ndarray, cx_px: float) -> np.ndarray:
    """Turn a camera about its y axis so that the middle of its image shows what its axis did."""
    angle = math.atan2(WIDTH / 2 - cx_px, FOCAL_PX)
    c, s = math.cos(angle), math.sin(angle)
    turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    return turn @ pose


def save_one_colour(pixels: np.ndarray, path: Path) -> None:
    save_png(np.full_like(pixels, 120), path)


def save_grey(pixels: np.ndarray, path: Path) -> None:
    Image.fromarray(pixels).convert("L").save(path)


def save_with_alpha(pixels: np.ndarray, path: Path) -> None:
    alpha = np.full(pixels.shape[:2], 255, np.uint8)
    alpha[:, :8] = 0
    save_png(np.dstack([pixels, alpha]), path)


def save_transparent(pixels: np.ndarray, path: Path) -> None:
    save_png(np.dstack([pixels, np.zeros(pixels.shape[:2], np.uint8)]), path)


def save_grey_16(pixels: np.ndarray, path: Path) -> None:
    Image.fromarray((pixels.mean(2) * 257).astype(np.uint16)).save(path)


def save_color_16(pixels: np.ndarray, path: Path) -> None:
    def chunk(kind: bytes, body: bytes) -> bytes:
        return (
            struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
        )

    height, width, _ = pixels.shape
    rows = b"".join(b"\0" + (row.astype(">u2") * 257).astype(">u2").tobytes() for row in pixels)
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 16, 2, 0, 0, 0))
        + chunk(b"IDAT", zlib.compress(rows))
        + chunk(b"IEND", b"")
    )


def save_lying(pixels: np.ndarray, path: Path) -> None:
    """Stored turned by a quarter, with the EXIF entry that turns it back."""
    exif = Image.Exif()
    exif[0x0112] = 6
    turned = np.ascontiguousarray(np.rot90(pixels, 1))
    Image.fromarray(turned).save(path, quality=97, subsampling=0, exif=exif)


FAR_CX_PX = WIDTH / 2 + 2 * WIDTH
ROW = [
    look_at_pose(np.array([x, -4.0, 1.5]), np.array([0.5 * x, 0, 0])) for x in np.linspace(-2, 2, 8)
]
MESHED = {
    "01 one photo of one colour": Case(ring(), replaced={4: save_one_colour}),
    "02 one channel": Case(ring(), save=save_grey),
    "03 alpha": Case(ring(), save=save_with_alpha),
    "04 grey of 16 bits": Case(ring(), save=save_grey_16),
    "05 colour of 16 bits": Case(ring(), save=save_color_16),
    "06 EXIF rotation": Case(ring(), save=save_lying, suffix=".jpg"),
    "07 different sizes": Case(ring(), sizes=[(64, 56), (80, 60), (56, 72)]),
    "08 centres on a line": Case(ROW),
    "09 principal point two widths off": Case(
        [beside(pose, FAR_CX_PX) for pose in ring()], cx_px=FAR_CX_PX
    ),
    "10 120 degrees": Case(ring(), focal_px=WIDTH / 2 / math.tan(math.radians(60))),
    "11 two places, five photos each": Case([ring()[0]] * 5 + [ring()[4]] * 5),
}
NEARLY = [
    look_at_pose(np.array([4.0, 0, 3]) + 1e-9 * shift, np.zeros(3))
    for shift in np.random.default_rng(0).normal(size=(6, 3))
]
REFUSED = {
    "12 all of one colour": (
        Case(ring(), save=save_one_colour), "10 photos show one colour only", "texture",
    ),
    "13 all transparent": (
        Case(ring(), save=save_transparent), "10 photos are masked altogether", "masks",
    ),
}  # fmt: skip
REFUSED_AT_ONCE = {
    "14 nearly one place": (Case(NEARLY), "from nearly one place", "Walk around"),
    "15 principal point 50 widths off": (
        Case(ring(), cx_px=50.0 * WIDTH), "principal point lies far outside", "Solve the cameras",
    ),
}  # fmt: skip


def wrapped(case: Case, place: Path) -> JobFolder:
    """Run a short job in this process; return its folder."""
    settings = JobSettings(
        training=TrainingSettings(iterations=60, max_gaussians=1200),
        meshing=MeshingSettings(points=400),
        texture=TextureSettings(size_px=64),
        export=("ply",),
    )
    folder = JobFolder(place / "out")
    folder.create()
    job = make_job("wrap", case.write(place / "input"), settings)
    run_job(folder, job, lambda event: None, lambda: False)
    return folder


@pytest.mark.parametrize("name", first_then_proofs(MESHED, 4))
def test_it_ends_in_a_closed_mesh(name: str, tmp_path: Path) -> None:
    folder = wrapped(MESHED[name], tmp_path)
    with np.load(folder.result / "auto" / "mesh.npz", allow_pickle=False) as arrays:
        vertices, faces = arrays["vertices"], arrays["faces"]
    assert np.isfinite(vertices).all()
    assert validate_manifold(vertices, faces, None).to_json()["good"]
    report = json.loads((folder.result / "report.json").read_text())
    codes = {warning["code"] for warning in report["cameras"]["warnings"]}
    expected = {"01": "photos-of-one-colour", "08": "cameras-on-a-line", "11": "cameras-on-a-line"}
    assert expected.get(name[:2]) in {*codes, None}
    views = len(MESHED[name].poses) - (name[:2] == "01")
    assert report["cameras"]["views"] == views
    if name[:2] in ("09", "10"):  # the region is around the ball, not where the axes lead to
        scene = json.loads((folder.result / "scene.json").read_text())["world_from_scene"]
        world = scene["scale"] * vertices @ np.array(scene["rotation"]).T + scene["translation"]
        assert np.linalg.norm(world.mean(0)) < 1.5
        assert np.ptp(world, axis=0).max() > 1.0


@pytest.mark.parametrize("name", REFUSED)
def test_it_is_refused_before_training(name: str, tmp_path: Path) -> None:
    case, message, hint = REFUSED[name]
    with pytest.raises(DatasetError, match=message) as caught:
        wrapped(case, tmp_path)
    assert hint in caught.value.hint
    assert caught.value.exit_code == EXIT_BAD_DATA
    assert not (tmp_path / "out" / "result").exists()
    assert not list((tmp_path / "out" / "stages").glob("train-*"))


@pytest.mark.parametrize(
    "name", first_then_proofs([*REFUSED_AT_ONCE, *REFUSED], len(REFUSED_AT_ONCE) + 1)
)
def test_the_command_line_says_what_is_wrong(name: str, tmp_path: Path) -> None:
    case, message, hint = {**REFUSED, **REFUSED_AT_ONCE}[name]
    source = case.write(tmp_path / "input")
    done = subprocess.run(
        [sys.executable, str(BATCH), "wrap", str(source), "--out", str(tmp_path / "out"),
         "--no-blend"],
        capture_output=True, text=True, check=False, timeout=300,
    )  # fmt: skip
    output = done.stdout + done.stderr
    assert done.returncode == EXIT_BAD_DATA, output
    assert "Traceback" not in output
    assert message in output
    assert hint in output
    # Seen before a worker starts, it leaves nothing; else the job with its log, and no result.
    assert (tmp_path / "out").exists() == (name in REFUSED)
    assert not (tmp_path / "out" / "result").exists()
