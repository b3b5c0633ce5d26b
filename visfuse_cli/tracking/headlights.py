"""Lamps at night: what is bright on a dark scene and shows no body is light, and no vehicle that could be measured."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from scipy.ndimage import map_coordinates

from visfuse_cli.records import Array, Frame, GroundCamera, Image
from visfuse_cli.tracking.targets import Track
from visfuse_cli.vision.empty import NIGHT
from visfuse_cli.vision.lens import distort_points
from visfuse_cli.vision.wireframe import silhouette

EVERY = 3  # frames: looked at no more often
BRIGHTER, DARKER = 15, 5  # grey levels between a picture and the empty scene
MOSTLY = 0.5  # of a silhouette that is brighter than the scene, to be light
OPAQUE, HARDLY = 0.25, 0.03  # of a silhouette that is darker: a body hides what is behind it; light darkens nothing
FAINT = 0.3  # of a silhouette that differs clearly from the scene, at least: else nothing is seen of it
SOFT = 0.76  # steepest change over two pixels as a share of the whole one: a body's border is sharper
REACH_PX, PLACES = 7, 48  # either side of a silhouette, and places along it
CONTRAST = 8  # grey levels across a border, to say anything
LEAST_AREA_PX = 30
REASON = "headlights: in the dark no body was seen"


class Headlights:
    """Looks at what is followed over a dark scene, and tells which of it was light alone."""

    def __init__(self, empty: Image, camera: GroundCamera) -> None:
        self._camera = camera
        self._empty = cv2.cvtColor(empty, cv2.COLOR_BGR2GRAY).astype(np.float32)
        self._seen: dict[int, list[Array]] = {}  # of the live tracks: (light, dark, softness) by frame
        self.dark = bool(np.median(self._empty) < NIGHT)

    def look(self, frame: Frame, tracks: Sequence[Track], headings: Sequence[float]) -> None:
        """Take in a frame in which tracks with headings (rad) were measured."""
        if not self.dark or frame.index % EVERY:
            return
        grey = cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY).astype(np.float32)
        for track, heading in zip(tracks, headings, strict=True):
            if track.samples[-1].measured:
                pose = np.append(track.steps[-1].posterior.mean[:2], heading)
                found = self._of(grey, silhouette(self._camera, pose, track.size))
                if found is not None:
                    self._seen.setdefault(track.id, []).append(found)

    def only_light(self, identity: int) -> bool:
        """Whether a track that has ended showed no body."""
        seen = self._seen.pop(identity, [])
        if not seen:
            return False
        light, dark, softness = np.nanmedian(np.array(seen), axis=0)
        shines = light > MOSTLY and (dark < HARDLY or (dark < OPAQUE and softness < SOFT))
        return bool(shines or light + dark < FAINT)

    def _of(self, grey: Array, hull: Array) -> Array | None:
        """Shares of a silhouette (k, 2) px that are brighter and darker than the scene, and how soft its border is."""
        if len(hull) and self._camera.ground.lens is not None:
            hull = distort_points(hull, self._camera.ground.lens)
        mask = np.zeros(grey.shape, np.uint8)
        if len(hull):
            cv2.fillConvexPoly(mask, np.round(np.clip(hull, -1e4, 1e4)).astype(np.int32), 1)
        inside = mask > 0
        if np.count_nonzero(inside) < LEAST_AREA_PX:
            return None
        change = (grey - self._empty)[inside]
        return np.array([np.mean(change > BRIGHTER), np.mean(change < -DARKER), steepness(grey, hull)])


def steepness(grey: Array, hull: Array) -> float:
    """The steepest change of a picture over two pixels across a hull's border (k, 2) px, as a share of the whole change
    there: near 1 at an edge, less where light fades; 1 where there is no contrast."""
    ends = np.vstack([hull, hull[:1]])
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(ends, axis=0), axis=1))])
    places = np.linspace(0, length[-1], PLACES, endpoint=False)
    edge = np.clip(np.searchsorted(length, places, side="right") - 1, 0, len(hull) - 1)
    along = (ends[edge + 1] - ends[edge]) / np.maximum(length[edge + 1] - length[edge], 1e-9)[:, None]
    at = ends[edge] + along * (places - length[edge])[:, None]
    normal = np.column_stack([along[:, 1], -along[:, 0]])
    points = at[:, None] + normal[:, None] * np.arange(-REACH_PX, REACH_PX + 1)[:, None]
    inside = ((points > 0) & (points < np.array(grey.shape[::-1]) - 1)).all(axis=(1, 2))
    profile = map_coordinates(grey, points[inside][..., ::-1].transpose(2, 0, 1), order=1)
    whole = np.abs(profile[:, :4].mean(axis=1) - profile[:, -4:].mean(axis=1))
    steep = np.abs(profile[:, 2:] - profile[:, :-2]).max(axis=1)
    told = whole > CONTRAST
    return float(np.median(steep[told] / whole[told])) if told.any() else 1.0
