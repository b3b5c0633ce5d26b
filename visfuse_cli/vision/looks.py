"""What a thing looks like, in few numbers: the colours down its middle, to know it again."""

from __future__ import annotations

import cv2
import numpy as np

from visfuse_cli.records import Array, Image
from visfuse_cli.vision import patches

BANDS = 5  # from top to bottom
INNER = 0.5  # share of the width that they cover
SAMPLES = 6  # of each band, both ways
HIDDEN = 0.2  # share of a target's box that others cover: from there on it is not looked for
COASTED_S = 0.25  # after which a target that is found again must look as it did
ALIKE = 30.0  # grey levels: looks that differ by less may be of one thing
SETTLED_S = 0.4  # s after it was found again, from which on its template is taken anew: it comes out bit by bit
KEEP_LOOKS = 0.95  # of what a target looked like, from frame to frame


def looks(picture: Image, quad: Array) -> Array:
    """Mean colours (BANDS, 3) BGR of a quad (4, 2) of a picture."""
    unit = patches.grid((SAMPLES, BANDS * SAMPLES))
    unit[:, 0] = 0.5 + INNER * (unit[:, 0] - 0.5)
    at = patches.warped(quad, unit).astype(np.float32)[None]
    seen = cv2.remap(picture, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(seen.reshape(BANDS, -1, 3).mean(axis=1), dtype=float)


def unlike(one: Array, other: Array) -> float:
    """Root mean square difference of two looks, in grey levels, a common change of brightness left out."""
    off = one - other
    return float(np.sqrt(np.mean((off - off.mean() * 0.7) ** 2)))
