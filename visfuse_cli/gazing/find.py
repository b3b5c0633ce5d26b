"""What moves by itself before a head that turns: normal flow that the turning leaves over, grown to regions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from visfuse_cli.gazing.head import Head
from visfuse_cli.moving.settings import ImmConfig
from visfuse_cli.records import Array, Image
from visfuse_cli.vision import normal_flow

ALIKE = 0.4  # overlap with the region of the frame before
KNOWN = 0.2  # overlap with what is followed already


@dataclass(slots=True)
class _Candidate:
    boxes: list[Array]


class Finder:
    """Finds regions that move, frame by frame."""

    def __init__(self, head: Head, config: ImmConfig) -> None:
        self._head, self._config = head, config
        self._candidates: list[_Candidate] = []

    def look(self, before: Image, after: Image, gazes: tuple[Array, Array], known: list[Array]) -> list[Array]:
        """Quads (4, 2) px of regions that moved for some frames and are none of the `known` boxes [x, y, w, h]."""
        K = self._head.lens.K
        R = self._head.rotation(gazes[1]).T @ self._head.rotation(gazes[0])
        was, there = normal_flow.turned(before, R, K)
        flow, gradient = normal_flow.normal_flow(was, after, self._config.flow.sigma)
        settings = self._config.segmentation
        least = settings.smallest * after.size
        held = [np.append(box[:2], box[:2] + box[2:]) for box in known]
        kept, ready = [], []
        for box, area in normal_flow.grown(flow, gradient, there, settings.residual_px):
            if area < least or any(_shared(box, other) > KNOWN for other in held):
                continue
            old = next((c for c in self._candidates if _shared(c.boxes[-1], box) > ALIKE), None)
            boxes = [*(old.boxes if old is not None else []), box]
            if len(boxes) < self._config.life.confirm_frames:
                kept.append(_Candidate(boxes))
                continue
            half = np.median([np.subtract(b[2:], b[:2]) for b in boxes], axis=0) / 2
            u0, v0, u1, v1 = np.concatenate([(box[:2] + box[2:]) / 2 - half, (box[:2] + box[2:]) / 2 + half])
            ready.append(np.array([[u0, v0], [u1, v0], [u1, v1], [u0, v1]]))
        self._candidates = kept
        return ready


def _shared(box: Array, other: Array) -> float:
    inner = np.clip(np.minimum(box[2:], other[2:]) - np.maximum(box[:2], other[:2]), 0, None)
    return float(np.prod(inner) / max(min(np.prod(box[2:] - box[:2]), np.prod(other[2:] - other[:2])), 1e-9))
