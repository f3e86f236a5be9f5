# SPDX-License-Identifier: GPL-3.0-or-later
"""Meet the fake setting on the command line, in a job file and in the table; no test by itself.

python -m tests.fake_setting_play GROUP
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import gaussian_wrapping_addon
from gaussian_wrapping_addon.command_line.options import (
    region_settings,
    training_settings,
    with_option_name,
)
from gaussian_wrapping_addon.command_line.parser import build_parser
from gaussian_wrapping_addon.core.errors import SettingError
from gaussian_wrapping_addon.core.jobs.store.job_file import make_job, read_job, write_job
from gaussian_wrapping_addon.core.settings import JobSettings
from tools import settings_table


def asked(*arguments: str) -> JobSettings:
    options = build_parser().parse_args(["wrap", "photos", "--out", "job", *arguments])
    return region_settings(training_settings(options), options)


def refusal(settings: JobSettings) -> str:
    try:
        settings.validated()
    except SettingError as error:
        return str(with_option_name(error))
    return ""


def main(group: str) -> None:
    def number(settings: JobSettings) -> int:
        return int(getattr(settings, group).fake_number)

    Path("photos").mkdir()
    path = Path("job.json").resolve()
    write_job(path, make_job("wrap", Path("photos"), asked("--set", "fake_number=7")))
    values = {
        "package": gaussian_wrapping_addon.__file__,
        "default": number(asked()),
        "fine": number(asked("--preset", "fine")),
        "given": number(asked("--set", "fake_number=7")),
        "refused": refusal(asked("--set", "fake_number=12")),
        "stored": json.loads(path.read_text())["settings"][group]["fake_number"],
        "read": number(read_job(path).settings),
        "table": [line for line in settings_table.table().splitlines() if "fake_number" in line],
        "outdated": settings_table.table() != Path("docs.md").read_text(encoding="utf-8"),
    }
    print(json.dumps(values))


if __name__ == "__main__":
    main(sys.argv[1])
