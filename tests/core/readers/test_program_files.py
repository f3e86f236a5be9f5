# SPDX-License-Identifier: GPL-3.0-or-later
"""Camera files of other programs: what becomes of them, and those that are refused."""

from __future__ import annotations

import json
import math
import re
import shutil
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gaussian_wrapping_addon.core.errors import DatasetError, ParseError
from gaussian_wrapping_addon.core.jobs.commands.estimate_command import input_facts
from gaussian_wrapping_addon.core.jobs.store.stage_folder import source_fingerprint
from gaussian_wrapping_addon.core.loading.check import check_input
from gaussian_wrapping_addon.core.loading.load import load_scene
from gaussian_wrapping_addon.core.loading.source_kind import source_kind
from gaussian_wrapping_addon.core.progress import Progress
from gaussian_wrapping_addon.core.readers.program_values import relative_names
from gaussian_wrapping_addon.core.readers.source_model import SourceModel
from gaussian_wrapping_addon.core.scene.frames import POINT_STEP
from gaussian_wrapping_addon.core.scene.scene import Scene
from tests.core.poses.test_solver import textured_plane
from tests.core.readers import writers
from tests.core.readers.known_scene import NAMES, read, shots, write_photos
from tests.core.readers.writers import Shots


def load(source: Path, work: Path) -> Scene:
    return load_scene(source, work, Progress(), seed=1, threads=1)


@pytest.mark.parametrize("program", ["meshroom", "opensfm"])
def test_poses_and_points_become_a_scene(tmp_path: Path, program: str) -> None:
    write, lens = LENSES[program]
    points = np.random.default_rng(4).uniform(-0.5, 0.5, (300, 3))
    write_photos(tmp_path / "set" / "images")
    made = shots(lens, points=points)
    path = write(tmp_path / "set", made)
    model = read(path)
    np.testing.assert_array_equal(model.points, points)
    assert model.point_colors.tolist() == [[200, 100, 50]] * 300
    scene = load(tmp_path / "set", tmp_path / "work")
    assert scene.facts["kind"] == model.kind
    assert scene.facts["photos_undistorted"] == 4
    centers = scene.world_from_scene.points(np.array([c.center for c in scene.cameras]))
    np.testing.assert_allclose(centers, made.centers(), atol=1e-5)
    step = POINT_STEP * scene.world_from_scene.scale
    np.testing.assert_allclose(scene.world_from_scene.points(scene.points), points, atol=step)
    assert (scene.point_colors == [200, 100, 50]).all()
    # Masks lie where they do for other inputs; photos may be nowhere.
    (tmp_path / "set" / "masks").mkdir()
    Image.new("L", (96, 64), 255).save(tmp_path / "set" / "masks" / "IMG_0002.png")
    texts = [finding.message for finding in check_input(tmp_path / "set")]
    assert "1 of 4 photos have a mask." in texts
    assert f"The input is of kind: {model.kind}." in texts
    shutil.rmtree(tmp_path / "set" / "images")
    with pytest.raises(DatasetError, match=f"None of the 4 photos that the {model.kind} names"):
        load(path, tmp_path / "work2")


def test_points_are_triangulated_where_the_file_has_none(tmp_path: Path) -> None:
    pytest.importorskip("pycolmap")
    cameras = textured_plane(tmp_path / "set")
    shutil.rmtree(tmp_path / "set" / "sparse")
    first, poses = cameras[0], [camera.cam_from_world for camera in cameras]
    lens = {"f": first.fx, "b1": first.fx - first.fy, "cx": 0.0}
    written = Shots([camera.name for camera in cameras], poses, first.width, first.height, lens)
    scene = load(writers.write_metashape(tmp_path / "set", written), tmp_path / "work")
    assert scene.facts["start_points"] == "triangulated from the photos"
    assert len(scene.points) >= 200
    world = scene.world_from_scene.points(scene.points)
    assert np.percentile(np.abs(world[:, 2]), 90) < 0.02  # cameras are 2.8 away


def test_a_project_of_opendronemap(tmp_path: Path) -> None:
    write_photos(tmp_path / "images")
    (tmp_path / "opensfm").mkdir()
    writers.write_opensfm(tmp_path / "opensfm", shots(LENSES["opensfm"][1]))
    for source in (tmp_path, tmp_path / "opensfm", tmp_path / "opensfm" / "reconstruction.json"):
        kind = source_kind(source)
        assert kind.kind == "OpenSfM reconstruction"
        assert kind.photo_roots[0] == tmp_path / "images"
        findings = check_input(source)
        assert not [f for f in findings if f.severity == "error"]
        assert findings[0].message == "4 photos: 4 of 96 x 64."


def test_polycam_prefers_corrected_cameras(tmp_path: Path) -> None:
    lens = {"fx": 80.0, "fy": 80.0, "cx": 48.0, "cy": 32.0}
    writers.write_polycam(tmp_path, shots(lens), corrected=False)
    write_photos(tmp_path / "keyframes" / "images")
    assert source_kind(tmp_path).program.path.name == "cameras"  # type: ignore[union-attr]
    writers.write_polycam(tmp_path, shots(lens))
    write_photos(tmp_path / "keyframes" / "corrected_images")
    for source in (tmp_path, tmp_path / "keyframes"):
        kind = source_kind(source)
        assert kind.program.path.name == "corrected_cameras"
        assert kind.photo_roots == [tmp_path / "keyframes" / "corrected_images"]
        assert not [f for f in check_input(source) if f.severity == "error"]


def test_xmp_files_without_a_pose_are_not_cameras(tmp_path: Path) -> None:
    begin = "<x:xmpmeta xmlns:x='adobe:ns:meta/'"
    unposed = (
        f"{begin}><d xmlns:xcr='http://www.capturingreality.com/ns/xcr/1.1#' xcr:Version='3'"
        " xcr:PosePrior='initial'/></x:xmpmeta>"
    )
    write_photos(tmp_path)
    for text in (unposed, f"{begin}/>"):
        for name in NAMES:
            (tmp_path / name).with_suffix(".xmp").write_text(text)
        assert source_kind(tmp_path).kind == "photos"


def test_estimates_and_stages_know_the_file(tmp_path: Path) -> None:
    write_photos(tmp_path / "images")
    path = writers.write_realityscan_csv(tmp_path, shots({"f": 30.0}))
    assert input_facts(path).photos == 4
    before = source_fingerprint(tmp_path)
    path.write_text(path.read_text().replace("30.0", "31.0"))
    assert source_fingerprint(tmp_path) != before


LENSES = {
    "csv": (writers.write_realityscan_csv, {"f": 30.0, "k1": 0.1}),
    "xmp": (writers.write_realityscan_xmp, {"f": 30.0, "k1": 0.1}),
    "metashape": (writers.write_metashape, {"f": 88.0, "k1": 0.1}),
    "meshroom": (writers.write_meshroom, {"f": 32.0, "k1": 0.1}),
    "opensfm": (writers.write_opensfm, {"focal_x": 0.9, "focal_y": 0.9, "k1": 0.1}),
    "opendrone": (writers.write_opendrone_shots, {"focal_x": 0.9, "focal_y": 0.9}),
    "polycam": (writers.write_polycam, {"fx": 80.0, "fy": 80.0, "cx": 48.0, "cy": 32.0}),
}


def written(folder: Path, program: str, **more: object) -> tuple[Path, Path]:
    """Write an input; return what to give, and the file to spoil."""
    write, lens = LENSES[program]
    write_photos(folder if program == "xmp" else folder / "images")
    source = write(folder, shots(lens, **more))
    if program == "xmp":
        return source, folder / "IMG_0001.xmp"
    if program == "polycam":
        return source, folder / "keyframes" / "corrected_cameras" / "IMG_0001.json"
    return source, source


def spoiled(folder: Path, program: str, old: str, new: str) -> Path:
    """Write an input in which the first match of ``old`` is replaced."""
    source, path = written(folder, program)
    text, count = re.subn(old, lambda _: new, path.read_text(), count=1)
    assert count == 1
    path.write_text(text)
    return source


def test_entities_are_not_expanded_and_depth_is_bounded(tmp_path: Path) -> None:
    source, path = written(tmp_path / "a", "metashape")
    laughs = '<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;"><!ENTITY c "&b;&b;&b;&b;">'
    for entities in (laughs, '<!ENTITY c SYSTEM "file:///etc/passwd">'):
        text = f'<?xml version="1.0"?><!DOCTYPE d [{entities}]><document><chunk label="&c;"/>'
        path.write_text(text + "</document>")
        with pytest.raises(ParseError, match="document types and entities are not read"):
            read(source)
        path.write_bytes(text.encode("utf-16"))
        with pytest.raises(DatasetError, match="not a transforms"):  # not even taken for one
            read(source)
    path.write_text("<document><chunk>" + "<a>" * 200_000)
    with pytest.raises(ParseError, match="line 1: nested too deeply"):
        read(source)
    source, path = written(tmp_path / "b", "xmp")
    text = '<!DOCTYPE d [<!ENTITY a "1">]>' + path.read_text()
    for encoding in ("utf-8", "utf-16"):
        path.write_bytes(text.encode(encoding) + b"<!-- capturingreality.com/ns/xcr Rotation -->")
        with pytest.raises(ParseError, match=r"IMG_0001\.xmp, line 1: document types and entities"):
            read(source)


@pytest.mark.parametrize(
    ("program", "old", "new", "words"),
    [
        ("csv", "heading", "bearing", r"cameras\.csv, line 1: columns are missing: heading"),
        ("csv", ",k4,", ",k2,", "line 1: a column is there twice"),
        ("csv", "t2", "k5", "line 1: lens coefficient k5 is not supported"),
        ("csv", "30.0,", "nan,", "line 2, f: the number is not finite"),
        ("csv", "30.0,", "0,", "line 2, f: the focal length is not positive"),
        ("csv", "30.0,", "wide,", "line 2, f: a number was expected"),
        ("csv", "30.0,", '"30', "line [0-9]*: not CSV"),
        ("csv", "30.0,", "", "line 2: 15 columns instead of 16"),
        ("xmp", "<xcr:Rotation>", "<xcr:Rotation>1 ", r"IMG_0001\.xmp, xcr:Rotation: 9 numbers"),
        ("xmp", "<xcr:Rotation>[^<]*", "<xcr:Rotation>1 0 0 0 1 0 0 0 -1", "the matrix mirrors"),
        ("xmp", "<xcr:Rotation>[^<]*", "<xcr:Rotation>2 0 0 0 2 0 0 0 2", "is not a rotation"),
        ("xmp", "brown4t2", "division", "the lens division is not supported.*Choose Brown"),
        ("xmp", 'Skew="0"', 'Skew="0.1"', "a skewed camera is not supported"),
        ("xmp", 'FocalLength35mm="30.0"', 'Focal="30.0"', "the focal length is missing"),
        ("xmp", "</rdf:RDF>", "", "not XML: mismatched tag"),
        ("metashape", "</chunk>", "", r"cameras\.xml, line [0-9]+: not XML: mismatched tag"),
        ("metashape", "<scale>2.5", "<scale>-2.5", "the scale is not positive"),
        ("metashape", "<f>88.0", "<f>1e300", "the number is not finite, or too large"),
        (
            "metashape", 'width="96"(?= height="64"/>\\s*<f>)', 'width="-96"',
            "image size -96 x 64 is out of range",
        ),
        ("metashape", 'sensor_id="0"', 'sensor_id="5"', "its sensor is not in the file"),
        ("metashape", 'frame" class', 'spherical" class', "the sensor type spherical is not"),
        ("metashape", "<k1>", "<p3>0.1</p3><k1>", "the coefficient p3 is not supported"),
        ("metashape", "<transform>[^<]*", f"<transform>{'0 ' * 16}", "last row is not 0 0 0 1"),
        ("meshroom", '"radialk3"', '"3deanamorphic4"', r"intrinsics\[0\]\.type: the lens pinhole"),
        ("meshroom", '"undistortionType": "none"', '"undistortionType": "x"', "a lens grid is not"),
        ("meshroom", '"focalLength": "32.0"', '"focalLength": "-1"', "a length is not positive"),
        ("meshroom", '"poseId": "200"', '"poseId": "200", "rigId": "3"', "a rig is not supported"),
        ("meshroom", '"intrinsicId": "7"', '"intrinsicId": "8"', "not among the intrinsics"),
        ("meshroom", '"center": \\[', '"center": [1,', "center: 3 numbers were expected"),
        ("opensfm", '"brown"', '"dual"', "the lens dual is not supported.*Choose"),
        ("opensfm", '"rotation": \\[', '"rotation": [1e99, ', "rotation: 3 numbers were expected"),
        ("opensfm", '"camera": "v2', '"camera": "v1', "it is not among the cameras"),
        ("opensfm", '"focal_x": 0.9', '"focal_x": 0', "focal length 0 x 86.4 px is out of range"),
        ("opensfm", '"shots": {', '"shots": [], "x": {', r"\[0\]\.shots: an object was expected"),
        ("opendrone", '"width": 96', '"width": 97', "0 lenses of cameras.json have its size"),
        ("opendrone", '"filename"', '"name"', r"features\[0\]: a shot with a filename"),
        ("polycam", '"t_11": ', '"t_11": 9', "the matrix is not a rotation"),
        ("polycam", '"t_23"', '"t_24"', r"IMG_0001\.json, t_23: a number was expected"),
        ("polycam", '"fx": 80.0', '"fx": 0', "focal length 0 x 80 px is out of range"),
    ],
)  # fmt: skip
def test_refused_with_file_and_place(
    tmp_path: Path, program: str, old: str, new: str, words: str
) -> None:
    source = spoiled(tmp_path, program, old, new)
    begun_s = time.perf_counter()
    with pytest.raises(DatasetError, match=words) as refused:
        read(source)
    assert refused.value.hint
    assert time.perf_counter() - begun_s < 5.0


@pytest.mark.parametrize("program", ["csv", "metashape", "meshroom", "opensfm", "opendrone"])
def test_large_files_are_not_read(tmp_path: Path, program: str) -> None:
    source, path = written(tmp_path, program)
    with path.open("r+b") as stream:
        stream.truncate(300 * 2**20)  # a sparse file
    with pytest.raises(ParseError, match="bytes are too many"):
        read(source)


def names_of(model: SourceModel) -> list[str]:
    return [photo.name for photo in model.photos]


@pytest.mark.parametrize("name", ["../../secret.jpg", "CON.jpg", "", "n" * 4000, NAMES[0]])
def test_unusable_names_are_left_out(tmp_path: Path, name: str) -> None:
    source, path = written(tmp_path, "meshroom")
    values = json.loads(path.read_text())
    values["views"][1]["path"] = name
    path.write_text(json.dumps(values))
    model = read(source)
    kept = [NAMES[0], NAMES[2], NAMES[3]]
    if name.endswith("secret.jpg"):  # its last part is looked for among the photos
        kept.insert(1, "secret.jpg")
    else:
        assert "1 photos were left out for a name" in model.warnings[0].text
    assert names_of(model) == kept


def test_names_of_another_computer(tmp_path: Path) -> None:
    def relative(*names: str) -> list[str]:
        return list(relative_names(names).values())

    assert relative("C:\\me\\set\\a\\1.jpg", "C:\\me\\set\\b\\1.jpg") == ["a/1.jpg", "b/1.jpg"]
    assert relative("/home/me/1.jpg") == ["1.jpg"]
    assert relative("/home/me/1.jpg", "sub/2.jpg") == ["1.jpg", "sub/2.jpg"]
    assert relative("C:/a/1.jpg", "D:/b/2.jpg") == ["a/1.jpg", "b/2.jpg"]
    found = relative("\\\\server\\x\\1.jpg", "../2.jpg", "./3.jpg")
    assert found == ["1.jpg", "2.jpg", "3.jpg"]
    for program in ("csv", "meshroom", "opensfm"):
        source, _ = written(tmp_path / program, program, stored_in="D:\\work\\house\\")
        assert names_of(read(source)) == list(NAMES)


def test_the_largest_reconstruction_is_used(tmp_path: Path) -> None:
    source, path = written(tmp_path, "opensfm")
    (entry,) = json.loads(path.read_text())
    small = {**entry, "shots": dict(list(entry["shots"].items())[:2])}
    path.write_text(json.dumps([small, entry]))
    model = read(source)
    assert len(model.photos) == 4
    assert "[1] with 4 photos was used, 2 photos are in others" in model.warnings[0].text


def test_components_and_disabled_cameras(tmp_path: Path) -> None:
    source, path = written(tmp_path / "a", "metashape")
    text = path.read_text()
    text = text.replace('component_id="0" label="IMG_0002"', 'component_id="1" label="IMG_0002"')
    text = text.replace('label="IMG_0003"', 'label="IMG_0003" enabled="false"')
    text = text.replace(
        " </chunk>",
        '<components><component id="0" label="one">'
        "<transform><rotation>1 0 0 0 1 0 0 0 1</rotation>"
        "<translation>10 20 30</translation><scale>2</scale></transform></component></components>"
        " </chunk>",
    )
    chunk_only = read(source)
    path.write_text(text)
    model = read(source)
    assert names_of(model) == ["IMG_0001", "IMG_0004"]
    said = " ".join(warning.text for warning in model.warnings)
    assert "one with 2 was used, 1 cameras are in others" in said
    assert "1 photos were left out for being disabled" in said
    # The component's transform stands in for the chunk's: scale 2.5 and translation 4 -3 2 there.
    a, b = (-m.photos[0].cam_from_world[:, :3].T @ m.photos[0].cam_from_world[:, 3]
            for m in (chunk_only, model))  # fmt: skip
    np.testing.assert_allclose((a - [4, -3, 2]) / 2.5, (b - [10, 20, 30]) / 2, atol=1e-12)
    source, path = written(tmp_path / "b", "xmp")
    path.write_text(path.read_text().replace("xcr:Skew", 'xcr:ComponentId="{A}" xcr:Skew', 1))
    model = read(source)
    assert names_of(model) == list(NAMES[1:])
    assert "1 photos were left out for another component" in model.warnings[0].text


def test_versions_of_meshroom_write_focal_lengths_in_four_ways(tmp_path: Path) -> None:
    source, path = written(tmp_path, "meshroom")
    values = json.loads(path.read_text())
    entry = values["intrinsics"][0]
    del entry["distortionType"], entry["undistortionType"]
    entry |= {"type": "radial3", "pixelRatio": "2", "principalPoint": ["49", "31"]}
    expected = {
        ("1", "0", "0"): ("90", (90.0, 90.0), (49.5, 31.5)),
        ("1", "2", "0"): (["90", "91"], (90.0, 91.0), (49.5, 31.5)),
        ("1", "2", "3"): ("", (32 / 36 * 96, 16 / 36 * 96), (97.5, 63.5)),
        ("1", "2", "6"): ("", (32 / 36 * 96, 64 / 36 * 96), (97.5, 63.5)),
    }
    for version, (focal, focal_px, center) in expected.items():
        path.write_text(json.dumps(values | {"version": version, "intrinsics": [
            entry | ({"pxFocalLength": focal} if focal else {})
        ]}))  # fmt: skip
        lens = read(source).photos[0].lens
        np.testing.assert_allclose(lens.focal, focal_px, rtol=1e-14)
        np.testing.assert_allclose(lens.principal_point, center, rtol=1e-14)


def test_half_turns_of_opensfm(tmp_path: Path) -> None:
    source, path = written(tmp_path, "opensfm")
    (entry,) = json.loads(path.read_text())
    entry["shots"][NAMES[0]]["rotation"] = [math.pi, 0.0, 0.0]
    entry["shots"][NAMES[1]]["rotation"] = [0.0, 0.0, 0.0]
    path.write_text(json.dumps([entry]))
    turned = [photo.cam_from_world[:, :3] for photo in read(source).photos[:2]]
    np.testing.assert_allclose(turned[0], np.diag([1.0, -1.0, -1.0]), atol=1e-15)
    np.testing.assert_array_equal(turned[1], np.eye(3))


@pytest.mark.parametrize("program", LENSES)
def test_the_folder_does_as_well_as_the_file(tmp_path: Path, program: str) -> None:
    source, path = written(tmp_path, program)
    of_file, of_folder = read(source), read(tmp_path)
    assert names_of(of_file) == names_of(of_folder)
    assert of_file.kind == of_folder.kind
    if program == "xmp":
        assert names_of(read(path)) == names_of(of_folder)
    if program == "csv":
        later = path.read_text().replace("heading", "yaw")  # later names of columns
        path.write_text(later.replace(",f,px,py", ",f_35mm,px_norm,py_norm"))
        after = read(source).photos
        assert [(p.name, p.relative) for p in after] == [
            (p.name, p.relative) for p in of_file.photos
        ]
        np.testing.assert_array_equal(after[0].cam_from_world, of_file.photos[0].cam_from_world)
        (tmp_path / "more.csv").write_bytes(path.read_bytes())
        with pytest.raises(DatasetError, match="2 files of kind RealityScan CSV"):
            read(tmp_path)
