# SPDX-License-Identifier: GPL-3.0-or-later
"""The thread count reaches every kernel: with one thread, no other is started."""

from __future__ import annotations

import sys

import pytest

from gaussian_wrapping_addon.core import parallel
from tests.core.kernels import kernel_stages


@pytest.mark.parametrize("stage", kernel_stages.STAGES)
def test_one_thread_starts_no_pool(stage: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise AssertionError("a part of the work chose its number of threads itself")

    monkeypatch.setattr(parallel, "_pool", refuse)
    patched = 0
    for name, module in list(sys.modules.items()):
        if name.startswith(kernel_stages.PACKAGE) and hasattr(module, "default_threads"):
            monkeypatch.setattr(module, "default_threads", refuse)
            patched += 1
    assert patched > 8
    assert kernel_stages.STAGES[stage]()


def test_the_pool_is_what_several_threads_start(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    usual = parallel._pool

    def count(threads: int) -> object:
        asked.append(threads)
        return usual(threads)

    monkeypatch.setattr(parallel, "_pool", count)
    monkeypatch.setattr(kernel_stages, "THREADS", 2)
    kernel_stages.STAGES["fields"]()
    assert set(asked) == {2}
