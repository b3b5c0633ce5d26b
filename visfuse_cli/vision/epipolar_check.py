"""Whether two views fit their calibration: how far matched features lie off their epipolar lines."""

from __future__ import annotations

import cv2
import numpy as np

from visfuse_cli.maths.planes import epipolar_offset
from visfuse_cli.records import Image, StereoRig

FEATURES = 1500
DISTINCT = 0.7  # ratio of the best match to the second best
LEAST = 25


def epipolar_residual(rig: StereoRig, left: Image, right: Image) -> tuple[float, int] | None:
    """Median distance (px) of matched features of undistorted views from their epipolar lines, and how many there were.

    None where too few features match to tell.
    """
    finder = cv2.ORB_create(FEATURES)  # type: ignore[attr-defined]
    grey = [cv2.cvtColor(view, cv2.COLOR_BGR2GRAY) for view in (left, right)]
    (one, here), (other, there) = (finder.detectAndCompute(view, None) for view in grey)
    if here is None or there is None or len(there) < 2:
        return None
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING)
    back = {match[0].queryIdx: match[0].trainIdx for match in matcher.knnMatch(there, here, k=1) if match}
    pairs = [
        (one[m[0].queryIdx].pt, other[m[0].trainIdx].pt)
        for m in matcher.knnMatch(here, there, k=2)
        if len(m) == 2 and m[0].distance < DISTINCT * m[1].distance and back.get(m[0].trainIdx) == m[0].queryIdx
    ]
    if len(pairs) < LEAST:
        return None
    z = np.array(pairs, dtype=float)
    return float(np.median(np.abs(epipolar_offset(rig, z[:, 0], z[:, 1])))), len(pairs)
