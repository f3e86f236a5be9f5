# SPDX-License-Identifier: GPL-3.0-or-later
"""Report section: the blocks of a training."""

from __future__ import annotations

from typing import Any

from .text import bytes_text, duration, items, number, part, table


def blocks_lines(training: dict[str, Any]) -> list[str]:
    """Return a table of the blocks as Markdown lines; none for a training in one piece."""
    blocks = [part(block) for block in items(training.get("blocks"))]
    if not blocks:
        return []
    rows = [
        (
            str(index),
            number(block.get("photos")),
            number(block.get("gaussians")),
            number(block.get("still")),
            number(block.get("iterations")),
            duration(block.get("seconds")),
            bytes_text(block.get("peak_memory_bytes")),
        )
        for index, block in enumerate(blocks)
    ]
    header = ("block", "photos", "Gaussians", "around it", "iterations", "time", "peak memory")
    return [
        "",
        (
            f"Trained in {len(blocks)} blocks, after a coarse training of the whole scene "
            f"({duration(training.get('seconds_coarse'))}), and joined. Photos and Gaussians of "
            "the margins count in several blocks; time and memory are those of its process so far."
        ),
        "",
        *table(header, rows, "rrrrrrr"),
    ]
