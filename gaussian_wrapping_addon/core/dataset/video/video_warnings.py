# SPDX-License-Identifier: GPL-3.0-or-later
"""Warnings about kinds of videos, the same when one is checked and when it is read."""

from __future__ import annotations

from pathlib import Path

from ...report_warning import ReportWarning


def hdr_warning(video: Path) -> ReportWarning:
    """Return the warning of a video with a transfer function of HDR."""
    return ReportWarning(
        "video-hdr",
        f"{video.name} is an HDR video (PQ or HLG): its colours are taken as they are stored, and "
        "look pale.",
        "Film without HDR, or export it as SDR.",
    )


def interlaced_warning(video: Path) -> ReportWarning:
    """Return the warning of an interlaced video."""
    return ReportWarning(
        "video-interlaced",
        f"{video.name} is interlaced: what moves has combs at its edges.",
        "Film or export it progressive.",
    )
