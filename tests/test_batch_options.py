# SPDX-License-Identifier: GPL-3.0-or-later
"""Options of the command line become the settings they name, and nothing else changes."""

from __future__ import annotations

import subprocess
import sys
from argparse import Namespace
from dataclasses import replace
from pathlib import Path

import pytest

from gaussian_wrapping_addon.command_line import mesh_commands
from gaussian_wrapping_addon.command_line.options import (
    method_settings,
    option_of,
    region_settings,
    training_settings,
)
from gaussian_wrapping_addon.command_line.parser import build_parser
from gaussian_wrapping_addon.core.errors import UsageError
from gaussian_wrapping_addon.core.jobs.commands import run_in_worker
from gaussian_wrapping_addon.core.settings import (
    MODEL_SELECTION,
    PRESETS,
    JobSettings,
    MeshingSettings,
    TextureSettings,
    preset,
    to_json,
)
from gaussian_wrapping_addon.core.settings.job import write_saved_settings

BATCH = Path(__file__).resolve().parents[1] / "gaussian_wrapping_addon" / "batch.py"

SWITCHES = {"harmonics": "on", "growth": "on", "wrapping": "off"}
DECIDED = tuple(name for name in MODEL_SELECTION if name not in SWITCHES)


def settings_of(*arguments: str) -> JobSettings:
    return training_settings(
        build_parser().parse_args(["wrap", "photos", "--out", "o", *arguments])
    )


@pytest.mark.parametrize("name", PRESETS)
def test_without_options_the_preset_stands(name: str) -> None:
    assert settings_of("--preset", name) == preset(name)


@pytest.mark.parametrize(
    ("option", "value", "name", "wanted"),
    [
        ("--iterations", "70", "iterations", 70),
        ("--max-gaussians", "700", "max_gaussians", 700),
        ("--max-image-px", "96", "max_image_px", 96),
        ("--set", "sh_degree=0", "sh_degree", 0),
        ("--holdout", "0", "holdout_every", 0),
        ("--set", "preview_every=2.5", "preview_every_s", 2.5),
        ("--set", "mask_mode=background", "mask_mode", "background"),
        *(("--set", f"{n}=off", n, "off") for n in DECIDED),
        *(("--set", f"{n}=on", n, "on") for n in MODEL_SELECTION if SWITCHES.get(n) != "on"),
        *(("--set", f"{n}=off", n, "off") for n in ("harmonics", "growth")),
    ],
)
def test_an_option_changes_its_setting_alone(
    option: str, value: str, name: str, wanted: object
) -> None:
    before, after = (
        to_json(preset("draft")),
        to_json(settings_of("--preset", "draft", option, value)),
    )
    assert after["training"][name] == wanted
    assert before["training"][name] != wanted
    before["training"][name] = wanted
    assert after == before


def parsed(command: str, *words: str) -> Namespace:
    """Return parsed options; a word with "=" is given with --set."""
    given = [w for word in words for w in (("--set", word) if "=" in word else (word,))]
    return build_parser().parse_args([*command.split(), "--out", "o", *given])


@pytest.mark.parametrize("command", ["wrap photos", "mesh"])
def test_clean_up_options_become_meshing_settings(command: str) -> None:
    def meshing(*arguments: str) -> MeshingSettings:
        options = parsed(command, *arguments)
        earlier = replace(preset("draft"), meshing=MeshingSettings(target_faces=77, smooth_steps=7))
        return region_settings(earlier, options).meshing

    assert meshing() == MeshingSettings(), "what an earlier mesh was given does not stay"
    assert meshing("method=pivots", "pivots=9") == MeshingSettings(method="pivots", pivots=9)
    assert meshing("spacing=uniform", "--points", "50", "tiles=3") == MeshingSettings(
        spacing="uniform", points=50, tiles="3"
    )
    assert meshing("--edge-length", "0.5") == MeshingSettings(edge_length=0.5)
    assert meshing("boundary=open") == MeshingSettings(boundary="open")
    assert meshing("method=pivots", "pivots=9", "pivot_box=gof") == MeshingSettings(
        method="pivots", pivots=9, pivot_box="gof"
    )
    assert meshing("method=pivots", "pivot_samples=none") == MeshingSettings(
        method="pivots", pivot_samples="none"
    )
    assert meshing("mesh_cameras=all") == MeshingSettings(cameras="all")
    assert meshing("unseen=occupied") == MeshingSettings(unseen="occupied")
    assert meshing("--faces", "5000") == MeshingSettings(target_faces=5000)
    assert meshing("smooth=3") == MeshingSettings(smooth_steps=3)
    assert meshing("parts=2") == MeshingSettings(most_parts=2)
    assert meshing("min_part=0.2") == MeshingSettings(min_component_share=0.2)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("method=pivots", "--points", "50"), ("--points 50", "--set method=pivots")),
        (
            ("method=pivots", "--edge-length", "0.1"),
            ("--edge-length 0.1", "--set method=pivots"),
        ),
        (
            ("method=pivots", "spacing=uniform"),
            ("--set spacing=uniform", "--set method=pivots"),
        ),
        (("method=pivots", "tiles=4"), ("--set tiles=4", "--set method=pivots")),
        (("pivots=9",), ("--set pivots=9", "--set method=pam")),
        (("method=pam", "pivots=2"), ("--set pivots=2", "--set method=pam")),
        (("pivot_box=gof",), ("--set pivot_box=gof", "--set method=pam")),
        (("pivot_samples=none",), ("--set pivot_samples=none", "--set method=pam")),
        (
            ("method=pivots", "pivot_box=gof"),
            ("--set pivot_box=gof", "--set pivots=9"),
        ),
    ],
)
@pytest.mark.parametrize("command", ["wrap photos", "mesh", "estimate-mesh"])
def test_options_that_the_method_does_not_heed_are_refused(
    command: str, arguments: tuple[str, ...], words: tuple[str, str]
) -> None:
    options = parsed(command, *arguments)
    with pytest.raises(UsageError) as refused:
        method_settings(options)
    assert all(word in refused.value.message for word in words)
    assert refused.value.hint


def test_words_that_ask_a_method_for_nothing_else_go_with_it() -> None:
    asked = ["mesh", "--out", "o", "--set", "method=pivots", "--points", "0", "--set", "tiles=off"]
    settings = MeshingSettings(**method_settings(build_parser().parse_args(asked)))
    assert settings == MeshingSettings(method="pivots", tiles="off")


@pytest.mark.parametrize("command", ["wrap photos", "mesh"])
def test_map_options_become_texture_settings(command: str) -> None:
    def texture(*arguments: str) -> TextureSettings:
        options = build_parser().parse_args([*command.split(), "--out", "o", *arguments])
        earlier = replace(preset("draft"), texture=TextureSettings(normal_map="on", lods=5))
        return region_settings(earlier, options).texture

    assert texture() == TextureSettings(), "what an earlier mesh was given does not stay"
    assert texture("--set", "normal_map=off") == TextureSettings(normal_map="off")
    assert texture("--set", "ambient_occlusion=on") == TextureSettings(ambient_occlusion="on")
    assert texture("--set", "lods=3") == TextureSettings(lods=3)


@pytest.mark.parametrize(("word", "wanted"), [("auto", "auto"), ("all", "on"), ("none", "off")])
def test_needs_sets_the_model_selection_and_a_single_option_wins(word: str, wanted: str) -> None:
    training = settings_of("--needs", word).training
    names = DECIDED if word == "auto" else MODEL_SELECTION
    assert {getattr(training, name) for name in names} == {wanted}
    other = "off" if wanted == "on" else "on"
    for arguments in (
        ("--needs", word, "--set", f"exposure={other}"),
        ("--set", f"exposure={other}", "--needs", word),
    ):
        training = settings_of(*arguments).training
        assert training.exposure == other
        assert {getattr(training, n) for n in names if n != "exposure"} == {wanted}


@pytest.mark.parametrize(
    "arguments", [("--needs", "some"), ("--set", "growth=yes"), ("--set", "sh_degree=x")]
)
def test_other_words_are_refused(arguments: tuple[str, str]) -> None:
    with pytest.raises(UsageError):
        settings_of(*arguments)


def test_a_preset_of_the_panel_is_taken_and_options_override_it(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    values = {
        "preset": "fine", "turntable": "on", "training.iterations": 0, "training.exposure": "off",
        "training.max_gaussians": 5000, "texture.size_px": 512, "meshing.edge_length": 0.5,
        "old": 1,
    }  # fmt: skip
    write_saved_settings(tmp_path / "mine.json", values, {})
    line = ["wrap", "photos", "--out", "o", "--user-preset", str(tmp_path / "mine.json")]

    def settings(*arguments: str) -> JobSettings:
        options = build_parser().parse_args([*line, *arguments])
        return region_settings(training_settings(options), options, texture_stays=True)

    fine = preset("fine")
    training = replace(fine.training, exposure="off", max_gaussians=5000)
    wanted = replace(fine, turntable="on", training=training, texture=TextureSettings(size_px=512))
    assert settings() == wanted
    assert "mine.json: 'old' is no setting of this version" in caplog.text
    assert settings("--max-gaussians", "6000", "--texture-size", "1024") == replace(
        wanted,
        training=replace(training, max_gaussians=6000),
        texture=TextureSettings(size_px=1024),
    )
    assert settings("--preset", "draft").training.iterations == preset("draft").training.iterations
    (tmp_path / "mine.json").unlink()
    with pytest.raises(UsageError, match=r"mine\.json cannot be read"):
        settings()


@pytest.mark.parametrize("name", PRESETS)
def test_presets_of_the_program_say_nothing_of_textures(name: str) -> None:
    assert preset(name).texture == TextureSettings()


@pytest.mark.parametrize(
    ("line", "message", "hint"),
    [
        (
            "wrap x --out o --frames abc",
            "--frames.*'abc'; give 0 .* or from 3 to 2000",
            "See p wrap --help.",
        ),
        ("wrap x --out o --nonsense", "unrecognized arguments: --nonsense", "See p wrap --help."),
        ("wrap x", "required: --out", "See p wrap --help."),
        ("status", "required: DIR", "Usage: p status [-h] DIR"),
    ],
)
def test_an_error_quotes_short_usages_only(line: str, message: str, hint: str) -> None:
    with pytest.raises(UsageError, match=message) as refused:
        build_parser("p").parse_args(line.split())
    assert refused.value.hint == hint


def test_model_selection_has_an_option_each() -> None:
    assert MODEL_SELECTION == (
        "harmonics", "exposure", "multi_view", "wrapping", "growth", "full_size",
        "dense_start", "refine_poses",
    )  # fmt: skip
    for name in MODEL_SELECTION:
        assert option_of(f"training.{name}") == f"--set {name}"


def test_set_takes_every_setting_without_an_option() -> None:
    given = settings_of("--set", "lambda-dssim=0.3", "--set", "sh_degree=0", "--set", "wrapping=on")
    training = given.training
    assert (training.lambda_dssim, training.sh_degree, training.wrapping) == (0.3, 0, "on")
    assert settings_of("--set", "sh_degree=0", "--set", "sh_degree=2").training.sh_degree == 2


@pytest.mark.parametrize(
    ("words", "message", "hint"),
    [
        ("--set wraping=on", "unknown setting 'wraping', the nearest is wrapping", "--help"),
        ("--set foo=1", "unknown setting 'foo'; the command settings lists them", "--help"),
        ("--set wrapping", "no value in 'wrapping'; give wrapping=VALUE", "--help"),
        ("--set wrapping=yes", "wrapping: invalid choice: 'yes' .choose from off, on", "--help"),
        ("--set sh_degree=x", "sh_degree: invalid int value: 'x'", "--help"),
        ("--set seed=3", "seed has an option of its own: --seed", "--help"),
        ("--wrapping on", "unrecognized arguments: --wrapping on", "Give it as --set wrapping="),
        ("--sh-degree=2", "unrecognized arguments: --sh-degree=2", "Give it as --set sh_degree="),
    ],
)
def test_a_wrong_setting_is_refused_with_the_right_one(words: str, message: str, hint: str) -> None:
    with pytest.raises(UsageError, match=message) as refused:
        build_parser().parse_args(["wrap", "x", "--out", "o", *words.split()])
    assert hint in refused.value.hint


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["wrap", "x", "--out", ""], "--out: an empty path"),
        (["wrap", "", "--out", "o"], "input: an empty path"),
        (["mesh", "--out", "o", "--set", "exposure=on"], "exposure is no setting of this command"),
    ],
)
def test_what_a_command_cannot_take_is_refused(words: list[str], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        build_parser().parse_args(words)


def test_settings_lists_what_set_takes(caplog: pytest.LogCaptureFixture) -> None:
    parser = build_parser()
    with caplog.at_level("INFO"):
        options = parser.parse_args(["settings", "patch", "deviation"])
        assert options.run(options) == 0
    words = [message.partition("=")[0] for message in caplog.messages]
    assert words == ["patch_contrast", "patch_rise"]
    with caplog.at_level("INFO"):
        options = parser.parse_args(["settings", "edge_length"])
        assert options.run(options) == 0
    assert any("see the option --edge-length" in message for message in caplog.messages)
    options = parser.parse_args(["settings", "no such words"])
    with pytest.raises(UsageError, match="No setting has no such words"):
        options.run(options)


def test_every_setting_that_an_option_gives_is_called_by_that_option() -> None:
    """Each path that an option is known for exists, and each option exists."""
    paths = {
        path
        for part, values in {**to_json(JobSettings()), "": to_json(JobSettings())}.items()
        for path in ([f"{part}.{n}".strip(".") for n in values] if isinstance(values, dict) else ())
    }
    known = {path: option for path in paths if (option := option_of(path))}
    wrap = set(build_parser()._subparsers._group_actions[0].choices["wrap"]._option_string_actions)
    own = {option for option in known.values() if not option.startswith("--set ")}
    assert own <= wrap
    assert wrap - own == {
        "-h", "--help", "--needs", "--out", "--no-blend", "--user-preset", "--plan-only", "--set",
    }  # fmt: skip
    assert len(wrap - {"-h"}) <= 30
    for name in ("preset", "meshing.min_component_share", "training.holdout_every"):
        assert name in known
    assert option_of("training.focus") == ""


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (
            ["wrap", "photos", "--out", "o", "--set", "start_splat=no.ply", "--no-blend"],
            3,
            "no.ply",
        ),
        (
            ["wrap", "photos", "--out", "o", "--set", "sh_degree=4", "--no-blend"],
            2,
            "--set sh_degree is",
        ),
        (["wrap", "photos", "--out", "o", "--faces", "3", "--no-blend"], 2, "--faces is"),
        (
            ["wrap", "photos", "--out", "o", "--set", "smooth=-1", "--no-blend"],
            2,
            "--set smooth is",
        ),
        (
            ["wrap", "photos", "--out", "o", "--set", "min_part=7", "--no-blend"],
            2,
            "--set min_part is",
        ),
        (["wrap", "photos", "--out", "o", "--set", "tiles=x", "--no-blend"], 2, "--set tiles is"),
        (["wrap", "photos", "--out", "o", "--texture-size", "7"], 2, "--texture-size is"),
        (["estimate-mesh", "--out", "photos", "--threads", "-1"], 2, "--threads is out of range. "),
        (["run-part", "photos", "train", "--threads", "2000"], 2, "--threads is out of range. "),
        (["farm", "worker", "tcp://127.0.0.1:1", "--slots", "0"], 2, "--slots is out of range. "),
        (["wrap", "photos", "--out", "o", "--processes", "0", "--no-blend"], 2, "--processes is"),
        (["wrap", "photos", "--out", "o", "--computers", "here", "--no-blend"], 2, "--computers"),
        (["wrap", "photos", "--out", "o", "--processes", "3", "--no-blend"], 2, "--processes has"),
        (["wrap", "photos", "--out", "o", "--certificates", "c"], 2, "--certificates has no"),
        (["evaluate", "m.ply", "--truth", "photos", "--threads", "-1"], 2, "--threads is"),
        (["wrap", "photos", "--out", "o", "--set", "lods=9", "--no-blend"], 2, "--set lods is"),
        (["wrap", "photos", "--out", "o", "--set", "pivots=4", "--no-blend"], 2, "--set: pivots"),
        (["more", "--out", "photos", "--iterations", "10", "--no-blend"], 2, "job.json"),
        (["more", "--out", "photos", "--no-blend"], 2, "--iterations"),
        (["estimate", "missing"], 3, "missing"),
        (["estimate", "photos", "--iterations", "0"], 2, "--iterations is out of range. Give from"),
        (["resume", "photos", "--max-gaussians", "2000", "--no-blend"], 2, "job.json"),
    ],
)
def test_bad_command_lines_end_with_words(
    tmp_path: Path, arguments: list[str], code: int, words: str
) -> None:
    (tmp_path / "photos").mkdir()
    done = subprocess.run(
        [sys.executable, str(BATCH), *arguments], cwd=tmp_path, capture_output=True, check=False
    )
    said = done.stdout.decode()
    assert (done.returncode, words in said, done.stderr) == (code, True, b""), said
    assert not (tmp_path / "o").exists()


def test_it_runs_as_a_script_of_blender(tmp_path: Path) -> None:
    """As ``blender --background -P batch.py -- check photos``: Blender's own options are left."""
    (tmp_path / "photos").mkdir()
    line = ["blender", "--background", "-P", str(BATCH), "--", "check", "photos"]
    script = (
        f"import runpy, sys\nsys.argv = {line!r}\n"
        f"runpy.run_path({str(BATCH)!r}, run_name='__main__')\n"
    )
    done = subprocess.run(
        [sys.executable, "-I", "-c", script], cwd=tmp_path, capture_output=True, check=False
    )
    assert done.returncode == 3, done
    assert b"error: " in done.stdout
    assert done.stderr == b""


def test_export_refuses_before_it_writes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    parser, out = build_parser(), tmp_path / "out"
    options = parser.parse_args(["export", str(tmp_path), "--out", str(out), "--format", "glb,usd"])
    monkeypatch.setattr(mesh_commands, "has_bpy", lambda: False)
    with pytest.raises(UsageError, match="Writing USD needs bpy") as caught:
        options.run(options)
    assert "blender --background" in caught.value.hint
    for text, wanted in (("glb,stl", "stl"), (",", "names no format")):
        options.format = text
        with pytest.raises(UsageError, match=wanted):
            options.run(options)
    options.format = "glb"
    with pytest.raises(UsageError, match="holds no job's result"):
        options.run(options)
    assert not out.exists()


def test_export_asks_the_worker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "result").mkdir()
    (tmp_path / "result" / "scene.json").write_text("{}")
    asked = []
    monkeypatch.setattr(
        run_in_worker, "run_in_worker", lambda request, **how: asked.append((request, how)) or 3
    )
    command = ["export", str(tmp_path), "--out", str(tmp_path / "o"), "--format", "obj,splat,obj"]
    command += ["--placed", "--lods", "--region", "a", "b", "--shading", "unlit"]
    options = build_parser().parse_args(command)
    assert options.run(options) == 3
    ((request, how),) = asked
    assert how["module"] == "jobs.commands.export_files"
    assert request == {
        "result": str(tmp_path / "result"), "out": str(tmp_path / "o"),
        "formats": ["obj", "splat"], "placed": True, "regions": ["a", "b"], "levels": True,
        "shading": "unlit",
    }  # fmt: skip


@pytest.mark.parametrize(("name", "elsewhere"), SWITCHES.items())
def test_parts_that_photos_do_not_decide_on(name: str, elsewhere: str) -> None:
    for word in PRESETS:
        given = getattr(settings_of("--preset", word, "--needs", "auto").training, name)
        assert given == ("on" if word == "paper" else elsewhere)
    asked = settings_of("--preset", "paper", "--set", f"{name}=off").training
    assert getattr(asked, name) == "off"
    with pytest.raises(UsageError, match="invalid choice: 'auto'"):
        settings_of("--set", f"{name}=auto")
