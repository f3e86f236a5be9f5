# SPDX-License-Identifier: GPL-3.0-or-later
"""Cancelling inside the loops of a training that look at many views for one iteration."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TypeVar

from ..progress import Progress

Item = TypeVar("Item")


def checked(items: Iterable[Item], progress: Progress) -> Iterator[Item]:
    """Yield the items, asking for cancelling before each one is made.

    A wrapping round renders up to sixty views, which takes longer than the two seconds within
    which a cancelled job stops. Where such a loop changes the state of a training only after its
    last view, ending it early leaves the state as it was before.

    Raises
    ------
    Cancelled
        Before the item after the request is asked for.
    """
    iterator = iter(items)
    while True:
        progress.check()
        try:
            item = next(iterator)
        except StopIteration:
            return
        yield item
