# SPDX-License-Identifier: GPL-3.0-or-later
"""Write ``requirements-worker-hashes.txt``: every file that Set Up Worker may install, by its hash.

    python -m tools.worker_hashes [--extras]

Run it from the root of the repository after ``requirements-worker.txt`` was changed, or with
``--extras`` after the table of extras (``core/worker/environment.py``) was: then a list for
each extra is written, and the main list stays as it is. uv resolves
the list for Python 3.11 to 3.13 on all systems at once and takes the hashes from the package index.
torch is left out, with what its builds for CUDA bring: the build for the processor comes from
PyTorch's own index on Linux, whose files have other hashes.
"""

from __future__ import annotations

import logging
import re
import subprocess
import sys
import tempfile
from pathlib import Path

from gaussian_wrapping_addon.core.worker.environment import EXTRA_HASHES_NAME, EXTRAS

ROOT = Path(__file__).resolve().parents[1]
WANTED = ROOT / "requirements-worker.txt"
TARGET = ROOT / "requirements-worker-hashes.txt"
UV = "uv==0.13.9"
LEFT_OUT = re.compile(r"(torch|triton|nvidia-[\w-]+|cuda-[\w-]+)==")
EXTRA_HEAD = """\
# Files of the extra "{name}" of Set Up Worker, by their hashes; made by
# python -m tools.worker_hashes --extras from the table of extras; do not edit.
"""
HEAD = """\
# Made from requirements-worker.txt by python -m tools.worker_hashes; do not edit. Set Up Worker
# installs these files and no others; torch follows by itself (docs/blender.md).
"""

_logger = logging.getLogger("tools.worker_hashes")


def kept(resolved: str) -> str:
    """Return the entries of a resolved list that are installed by their hashes."""
    entries = re.split(r"\n(?=\S)", resolved.strip())
    return HEAD + "\n".join(e for e in entries if not LEFT_OUT.match(e)) + "\n"


def resolved(uv: Path, wanted: Path, out: Path, *options: str) -> str:
    """Return what a list resolves to, each file by its hash."""
    command = [
        str(uv), "pip", "compile", str(wanted), "--universal", "--python-version", "3.11",
        "--generate-hashes", "--no-annotate", "--no-header", "--output-file", str(out), "--quiet",
        *options,
    ]  # fmt: skip
    subprocess.run(command, check=True)
    return out.read_text(encoding="utf-8")


def main(arguments: list[str]) -> int:
    """Resolve and write; return the exit code."""
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    with tempfile.TemporaryDirectory() as folder:
        tool, out = Path(folder) / "uv", Path(folder) / "resolved.txt"
        pip = [sys.executable, "-m", "pip", "install", "-q", "--target", str(tool), UV]
        subprocess.run(pip, check=True)
        uv = tool / "bin" / "uv"
        if "--extras" not in arguments:
            TARGET.write_text(kept(resolved(uv, WANTED, out)), encoding="utf-8")
            _logger.info("%s", TARGET)
            return 0
        for extra in EXTRAS:
            wanted = Path(folder) / "wanted.txt"
            wanted.write_text("\n".join(extra.pins) + "\n", encoding="utf-8")
            target = ROOT / EXTRA_HASHES_NAME.format(extra.name)
            text = resolved(uv, wanted, out, "--no-deps")
            target.write_text(EXTRA_HEAD.format(name=extra.name) + text, encoding="utf-8")
            _logger.info("%s", target)
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
