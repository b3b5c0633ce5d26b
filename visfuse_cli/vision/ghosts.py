"""What is missing from a picture is told from what is new in it, so that a car that drove off leaves no ghost."""

from __future__ import annotations

import cv2
import numpy as np

from visfuse_cli.records import Image

STILL = 14  # grey levels that a still pixel may change
LEAST_PX = 24  # of a ghost
SHARPER = 1.6  # times as much contrast along its outline has a thing in the picture that shows it
CONTRAST = 12.0  # of Sobel's operator, at least, for there to be a thing at all
AMIDST = 0.5  # share of its surroundings that moved: of a large thing of one colour, a part seems to stand still


def find_ghosts(grey: Image, earlier: Image, still_moved: Image, differs: Image, background: Image) -> Image:
    """Mask (H, W), 255 where a thing that the `background` still shows has left the picture `grey`.

    `earlier` is the grey picture a while before; `still_moved` (255) was foreground then and now, `differs` (not 0) is
    foreground or shadow now. The outline of a ghost has its contrast in the background, that of a thing that stands has
    it in the picture.
    """
    mask = cv2.bitwise_and(still_moved, cv2.compare(cv2.absdiff(grey, earlier), STILL, cv2.CMP_LT))
    mask = cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    ghosts = np.zeros_like(mask)
    count, part, extent, _ = cv2.connectedComponentsWithStats(mask, connectivity=4, ltype=cv2.CV_16U)
    if count == 1:
        return ghosts
    square = np.ones((5, 5), np.uint8)
    wider, inner = cv2.dilate(part, square), cv2.erode(mask, np.ones((3, 3), np.uint8))
    on_outline = (wider > 0) & (inner == 0)
    whose = wider[on_outline]
    length = np.maximum(np.bincount(whose, minlength=count), 1)
    around = (wider > 0) & (mask == 0)
    beside = np.maximum(np.bincount(wider[around], minlength=count), 1)
    moved = np.bincount(wider[around & (differs > 0)], minlength=count) / beside
    here, there = (
        np.bincount(whose, weights=_contrast(picture)[on_outline], minlength=count) / length
        for picture in (grey, background)
    )
    gone = (there > SHARPER * here) & (there > CONTRAST) & (extent[:, cv2.CC_STAT_AREA] >= LEAST_PX) & (moved < AMIDST)
    gone[0] = False
    ghosts[gone[part]] = 255
    return np.asarray(cv2.dilate(ghosts, square), dtype=np.uint8)


def _contrast(picture: Image) -> np.ndarray:
    """Length of the gradient (H, W) of a smoothed grey picture."""
    smooth = cv2.GaussianBlur(picture, (5, 5), 0)
    return np.asarray(cv2.magnitude(cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)))
