# SPDX-License-Identifier: GPL-3.0-or-later
"""Helper process: find printed markers in photos with OpenCV.

In: ``task.json`` with the dictionary and paths of photos. Out: ``markers.json``, for each photo the
numbers and corners of its markers. Photos are decoded by our own reader.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ...files import read_json, write_json
from ...processes.helper_process import emit
from ...processes.worker_extras import load_extra
from ..photos.photo_file import read_photo
from .marker_edges import refined_corners

TASK, RESULT = "task.json", "markers.json"
MARKERS_EXTRA = "markers"
BORDER_BITS = 1
"""Width of the black border of a printed marker, in bits."""
MAX_MARKERS_A_PHOTO = 1000


def main(folder: Path) -> None:
    """Detect the markers of every photo of the task."""
    cv2 = load_extra(MARKERS_EXTRA, "--markers")
    task = read_json(folder / TASK)
    cv2.setNumThreads(int(task["threads"]))
    dictionary = cv2.aruco.getPredefinedDictionary(_number(cv2, str(task["dictionary"])))
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(dictionary, parameters)
    modules = int(dictionary.markerSize) + 2 * BORDER_BITS
    found: list[list[dict[str, Any]]] = []
    photos = task["photos"]
    for i, path in enumerate(photos):
        grey = _grey(read_photo(Path(path)).color)
        corners, numbers, _ = detector.detectMarkers(grey)
        found.append(_markers(grey, corners, numbers, modules))
        emit(fraction=(i + 1) / len(photos), message=f"markers of photo {i + 1} of {len(photos)}")
    write_json(folder / RESULT, found)


def _number(cv2: Any, name: str) -> int:
    """Return OpenCV's number of a dictionary, whatever case its name is in."""
    wanted = f"dict_{name}"
    return next(getattr(cv2.aruco, n) for n in dir(cv2.aruco) if n.lower() == wanted)


def _grey(color: np.ndarray) -> np.ndarray:
    """Return (h, w) uint8 luma of (h, w, 3) uint8."""
    red, green, blue = (color[..., k].astype(np.uint16) for k in range(3))
    return np.ascontiguousarray(((77 * red + 150 * green + 29 * blue) >> 8).astype(np.uint8))


def _markers(grey: np.ndarray, corners: Any, numbers: Any, modules: int) -> list[dict[str, Any]]:
    out = []
    for number, quad in zip(np.ravel(numbers if numbers is not None else []), corners, strict=True):
        # OpenCV's first pixel has its centre at (0, 0).
        rough = np.asarray(quad, np.float64).reshape(4, 2) + 0.5
        exact = refined_corners(grey, rough, modules)
        refined = exact is not None
        out.append(
            {
                "number": int(number),
                "corners_px": (exact if exact is not None else rough).tolist(),
                "refined": refined,
            }
        )
    return out[:MAX_MARKERS_A_PHOTO]
