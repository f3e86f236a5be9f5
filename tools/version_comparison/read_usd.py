# SPDX-License-Identifier: GPL-3.0-or-later
"""Print what USD files hold, one JSON object a file: ``{"/prim.attribute": "type hash"}``.

Bytes of the files themselves cannot be compared: USD writes its tables in the order of addresses in
memory. Run in a process of its own, because bpy cannot be unloaded.
"""

from __future__ import annotations

import hashlib
import json
import sys

import bpy
import numpy as np


def _digest(value: object) -> str:
    value = getattr(value, "path", value)  # of an asset: as written, not where it was found
    try:
        data = np.asarray(value)
        content = data.tobytes() if data.dtype.kind in "fiub" else repr(value).encode()
    except (TypeError, ValueError):
        content = repr(value).encode()
    return hashlib.sha256(content).hexdigest()


def main(paths: list[str]) -> None:
    """Read the files with Blender's own USD library."""
    bpy.utils.expose_bundled_modules()
    from pxr import Usd

    for path in paths:
        stage = Usd.Stage.Open(path)
        found = {}
        for prim in stage.TraverseAll():
            found[str(prim.GetPath())] = str(prim.GetTypeName())
            for attribute in prim.GetAttributes():
                text = f"{attribute.GetTypeName()} {_digest(attribute.Get())}"
                found[str(attribute.GetPath())] = text
            for relation in prim.GetRelationships():
                found[str(relation.GetPath())] = str([str(t) for t in relation.GetTargets()])
        sys.stdout.write(json.dumps(found) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
