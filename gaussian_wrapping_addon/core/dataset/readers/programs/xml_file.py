# SPDX-License-Identifier: GPL-3.0-or-later
"""Bounded reader of XML: no document types, no entities, limits on size, depth and elements."""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

from .... import limits
from ....errors import ParseError
from ....regular_files import read_bounded

MAX_XML_BYTES = 64 * 1024 * 1024
"""A camera of a Metashape project takes about 1 kB: 64 MB are 60 000 of them."""
_MAX_ELEMENTS = 4_000_000
"""Memory of the tree: about 0.3 kB an element."""
_AGAIN = "Export the file again."


class _RefusedError(Exception):
    """What the file holds is not read: the reason is the argument."""


def read_xml(path: Path, most_bytes: int = MAX_XML_BYTES) -> Element:
    """Read an XML file and return its root; names with a namespace are ``{uri}name``.

    Raises
    ------
    ParseError
        Not XML, larger or deeper than the limits, or with a document type or entities, which a
        hostile file uses to expand without bounds or to name other files.
    """
    try:
        data = read_bounded(path, most_bytes, follow_links=True)
    except PermissionError as error:
        raise ParseError(
            path, "whole file", f"cannot be read: {error.strerror}.", "Check its permissions."
        ) from error
    parser = expat.ParserCreate(namespace_separator="}")
    parser.buffer_text = True
    builder = TreeBuilder()
    depth = elements = 0

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth, elements
        depth += 1
        elements += 1
        if depth > limits.MAX_JSON_DEPTH:
            raise _RefusedError("nested too deeply.")
        if elements > _MAX_ELEMENTS:
            raise _RefusedError(f"more than {_MAX_ELEMENTS} elements are too many.")
        builder.start(_full(tag), {_full(key): value for key, value in attributes.items()})

    def end(tag: str) -> None:
        nonlocal depth
        depth -= 1
        builder.end(_full(tag))

    def refuse(*_: object) -> int:
        raise _RefusedError("document types and entities are not read.")

    parser.StartElementHandler = start
    parser.EndElementHandler = end
    parser.CharacterDataHandler = builder.data
    parser.StartDoctypeDeclHandler = refuse
    parser.EntityDeclHandler = refuse
    parser.ExternalEntityRefHandler = refuse
    try:
        parser.Parse(data, True)
    except _RefusedError as error:
        raise ParseError(path, f"line {parser.CurrentLineNumber}", str(error), _AGAIN) from None
    except (expat.ExpatError, ValueError, LookupError) as error:
        # Besides its own errors expat raises those of Python's decoders.
        reason = expat.errors.messages.get(getattr(error, "code", -1), str(error))
        raise ParseError(
            path, f"line {parser.CurrentLineNumber}", f"not XML: {reason}.", _AGAIN
        ) from None
    return builder.close()


def _full(name: str) -> str:
    """Return a name as ElementTree writes it: expat gives ``uri}name``."""
    return f"{{{name}" if "}" in name else name
