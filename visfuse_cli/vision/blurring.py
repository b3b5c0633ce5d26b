"""Parts of a picture made unrecognisable for good."""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np

from visfuse_cli.records import Array, Image

CELLS = 5  # across the smaller side of what is blurred: a plate keeps no letter, a head no face
LEAST_PX = 6  # side of a cell


def blur(image: Image, outlines: Iterable[Array]) -> None:
    """Make what lies inside convex outlines (k, 2) px unrecognisable, in place: cells of one colour, smoothed."""
    height, width = image.shape[:2]
    for outline in outlines:
        if len(outline) < 3 or not np.isfinite(outline).all():
            continue
        low = np.clip(np.floor(outline.min(axis=0)), 0, [width, height]).astype(int)
        high = np.clip(np.ceil(outline.max(axis=0)) + 1, 0, [width, height]).astype(int)
        if (high - low).min() < 1:
            continue
        part = image[low[1] : high[1], low[0] : high[0]]
        size = (int(high[0] - low[0]), int(high[1] - low[1]))
        cell = max(LEAST_PX, min(size) / CELLS)
        coarse = (max(1, round(size[0] / cell)), max(1, round(size[1] / cell)))
        cells = cv2.resize(cv2.resize(part, coarse, interpolation=cv2.INTER_AREA), size, interpolation=cv2.INTER_LINEAR)
        mask = np.zeros(part.shape[:2], np.uint8)
        cv2.fillConvexPoly(mask, np.round(cv2.convexHull((outline - low).astype(np.float32))).astype(np.int32), 255)
        cv2.copyTo(cells, mask, part)
