"""What moves by itself: flow that the camera's motion leaves over, in regions of one motion, place and colour."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np

from visfuse_cli.moving.head import Head, Pair
from visfuse_cli.moving.settings import ImmConfig
from visfuse_cli.records import Array, Image, StereoRig
from visfuse_cli.vision import clusters
from visfuse_cli.vision.flow import own_motion

SAMPLES = 3000  # pixels that are clustered, at most
FILLED = 0.3  # share of a region's box that moves by itself
AROUND = np.array([0.2, 0.3])  # of its sides: around what is followed already nothing is looked for
THIN, FEWEST = 3, 50  # of the pixels, each way, that tell what is usual, and the fewest of these
FARTHEST_M = 40.0
NEAR = 0.25  # of the larger side of the smaller region: a gap across which both may be one thing
BELOW = 0.2  # of its height: how much ground below its feet may seem to move with it
WIDER, KEPT = 0.15, 0.35  # how far around a box its outline is looked for, and the least share of a side then left
BESIDE = 0.2  # of its width: what lies beside it and nearer may hide part of it
RIM = 3.0  # px from the edge of the picture
SLOWEST = 0.15  # m/s that a region must do in the world


@dataclass(slots=True)
class _Candidate:
    box: Array  # [u0, v0, u1, v1] px
    seen: int
    motion: Array


@dataclass(frozen=True, slots=True)
class Found:
    """What moves by itself: left quad (4, 2) px, velocity (3,) m/s in the world but along the axis, depth m."""

    quad: Array
    velocity: Array
    depth: float


class Finder:
    """Finds regions that move in the world, frame by frame."""

    def __init__(self, rig: StereoRig, config: ImmConfig, size: tuple[int, int]) -> None:
        self._rig, self._config = rig, config
        focal, most = rig.left.K[0, 0], 1.0
        wanted = focal * rig.baseline / most
        self._disparities = int(np.clip(np.ceil(min(wanted, size[0] / 2) / 16) * 16, 16, 192))
        turned = not np.allclose(rig.R, np.eye(3), atol=1e-9) or abs(rig.T[1]) + abs(rig.T[2]) > 1e-9
        self._maps = self._rectified(size) if turned or not np.allclose(rig.left.K, rig.right.K) else None
        self._matcher = cv2.StereoSGBM_create(  # type: ignore[attr-defined]
            0, self._disparities, 5, 8 * 25, 32 * 25, 1, 31, 10, 60, 2
        )
        self._candidates: list[_Candidate] = []
        self._warm = np.zeros((0, 7))  # mean features of the clusters in the frame before
        self._before: tuple[Head, Future[Array]] | None = None
        self._beside = ThreadPoolExecutor(1, "visfuse-depth")

    def _rectified(self, size: tuple[int, int]) -> tuple[list[tuple[Array, Array]], float, Array, Array]:
        """Maps of both views to rows that agree, their focal length, where (H, W, 2) the left view's pixels then lie,
        and the depth (H, W) there of a point one metre before the left view.
        """
        rig = self._rig
        none = np.zeros(5)
        R1, R2, P1, _, _, _, _ = cv2.stereoRectify(
            rig.left.K, none, rig.right.K, none, size, rig.R, rig.T[:, None], alpha=0
        )
        maps = [
            cv2.initUndistortRectifyMap(K, none, R, P1[:, :3], size, cv2.CV_32FC1)
            for K, R in ((rig.left.K, R1), (rig.right.K, R2))
        ]
        u, v = np.meshgrid(np.arange(size[0], dtype=float), np.arange(size[1], dtype=float))
        rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(rig.left.K).T @ R1.T
        at = rays @ P1[:, :3].T
        return maps, float(P1[0, 0]), (at[..., :2] / at[..., 2:]).astype(np.float32), np.maximum(rays[..., 2], 1e-6)

    def _depth(self, left: Image, right: Image) -> Array:
        """Depth (H, W) m of the left view; infinite where nothing is known."""
        if self._maps is None:
            disparity = self._matched(left, right)
            focal = self._rig.left.K[0, 0]
            return np.where(disparity > 0.5, focal * self._rig.baseline / np.maximum(disparity, 0.5), np.inf)
        maps, focal, at, share = self._maps
        pair = [cv2.remap(view, *own, cv2.INTER_LINEAR) for view, own in zip((left, right), maps, strict=True)]
        disparity = self._matched(*pair)
        depth = np.where(disparity > 0.5, focal * self._rig.baseline / np.maximum(disparity, 0.5), np.inf)
        near = cv2.remap(depth.astype(np.float32), at, None, cv2.INTER_NEAREST, borderValue=np.inf)
        return np.asarray(near / share, dtype=float)

    def _matched(self, left: Image, right: Image) -> Array:
        """Disparity (H, W) px; the matcher leaves out as many columns as it tries disparities, so it gets them more."""
        more = [cv2.copyMakeBorder(view, 0, 0, self._disparities, 0, cv2.BORDER_REPLICATE) for view in (left, right)]
        return np.asarray(self._matcher.compute(*more)[:, self._disparities :].astype(np.float32) / 16, dtype=float)

    def rest(self) -> None:
        """Nothing is looked for in this frame."""
        self._before, self._candidates = None, []

    def look(self, pair: Pair, grey: Image, known: list[Array]) -> list[Found]:
        """What moved for some frames in the left view and is none of the `known` boxes [x, y, w, h]."""
        before = self._before
        right = cv2.cvtColor(pair.pictures["right"], cv2.COLOR_BGR2GRAY)
        # The matcher works beside the rest: its depth is needed one pair later.
        self._before = (pair.head, self._beside.submit(self._depth, grey, np.asarray(right, np.uint8)))
        if before is None or pair.flow is None:
            return []
        head, depth = before[0], before[1].result()
        mask, rest = self._moving(depth, pair.flow, head, pair.head)
        for box in known:
            low = np.maximum(box[:2] - AROUND * box[2:], 0).astype(int)
            top = np.maximum(box[:2] + (1 + AROUND) * box[2:] + 1, 0).astype(int)
            mask[low[1] : top[1], low[0] : top[0]] = 0
        regions = self._whole(self._regions(mask, rest, pair.pictures["left"]), depth, rest)
        return self._confirmed(regions, depth, rest, pair.flow, pair.head.t - head.t, pair.head)

    def _moving(self, depth: Array, flow: Array, before: Head, now: Head) -> tuple[Image, Array]:
        """Where (H, W) the flow is not what the camera's own motion gives at that depth, and what it leaves over."""
        R, t = now.R.T @ before.R, now.R.T @ (before.T - now.T)
        explained = own_motion(depth, self._rig.left.K, R, t)
        rest = flow - explained
        usable = (depth < FARTHEST_M) & np.isfinite(rest[..., 0])
        sample = rest[::THIN, ::THIN][usable[::THIN, ::THIN]]
        if len(sample) < FEWEST:
            return np.zeros(depth.shape, np.uint8), rest
        middle = np.median(sample, axis=0)
        spread = 1.4826 * np.median(np.abs(sample - middle))
        # Near things have more flow, and so more of its error.
        flowing = np.hypot(explained[..., 0], explained[..., 1])
        least = self._config.segmentation.residual_px + 3 * spread + 0.12 * flowing
        off = np.hypot(rest[..., 0] - middle[0], rest[..., 1] - middle[1])
        mask = (usable & (off > least)).astype(np.uint8)
        mask = cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
        return np.asarray(cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((7, 7), np.uint8)), np.uint8), rest

    def _regions(self, mask: Image, rest: Array, picture: Image) -> list[tuple[Array, Array]]:
        """Boxes [u0, v0, u1, v1] and masks (H, W) of clusters of moving pixels. Jia 2008, sec. 2."""
        v, u = np.nonzero(mask)
        settings = self._config.segmentation
        least = settings.smallest * mask.size
        if len(u) < least:
            return []
        step = max(1, len(u) // SAMPLES)
        v, u = v[::step], u[::step]
        features = np.column_stack([rest[v, u], u, v, picture[v, u][:, ::-1]]).astype(float)
        weights = clusters.WEIGHTS.copy()
        if np.ptp(picture[v, u].astype(int), axis=1).max() < 4:
            weights[4:] = 1e-3  # grey footage: one brightness told thrice
        white = clusters.whitened(np.concatenate([features, self._warm]), weights)
        points, warm = white[: len(features)], white[len(features) :]
        labels = clusters.segmented(points, settings.most, settings.clusters, warm)
        self._warm = np.array([features[labels == label].mean(axis=0) for label in np.unique(labels)])
        found = []
        for label in np.unique(labels):
            own = np.zeros_like(mask)
            own[v[labels == label], u[labels == label]] = 1
            own = cv2.dilate(own, np.ones((2 * step + 1, 2 * step + 1), np.uint8)) & mask
            _, parts, blobs, _ = cv2.connectedComponentsWithStats(own)
            for k, (x, y, w, h, area) in enumerate(blobs[1:], start=1):
                if area >= least and area > FILLED * w * h and min(w, h) >= 8:
                    found.append((np.array([x - 0.5, y - 0.5, x + w - 0.5, y + h - 0.5]), parts == k))
        return found

    def _whole(self, regions: list[tuple[Array, Array]], depth: Array, rest: Array) -> list[tuple[Array, Array]]:
        """Regions side by side that are as far away and move alike, joined: the colours of one thing differ."""
        regions, k = list(regions), 0
        while k < len(regions):
            box, own = regions[k]
            other = next(
                (j for j in range(k + 1, len(regions)) if self._one(regions[k], regions[j], depth, rest)), None
            )
            if other is None:
                k += 1
                continue
            more, its = regions.pop(other)
            regions[k] = (
                np.append(np.minimum(box[:2], more[:2]), np.maximum(box[2:], more[2:])),
                np.logical_or(own, its),
            )
            k = 0
        return regions

    def _one(self, first: tuple[Array, Array], second: tuple[Array, Array], depth: Array, rest: Array) -> bool:
        (box, own), (other, its) = first, second
        gap = np.maximum(box[:2], other[:2]) - np.minimum(box[2:], other[2:])
        if np.any(gap > NEAR * np.minimum(box[2:] - box[:2], other[2:] - other[:2]).max()):
            return False
        fb = self._rig.left.K[0, 0] * self._rig.baseline
        one, two = (fb / float(np.median(depth[mask])) for mask in (own, its))
        here, there = (np.median(rest[mask], axis=0) for mask in (own, its))
        alike = np.linalg.norm(here - there) < max(0.7, 0.4 * float(np.linalg.norm(here)))
        return bool(abs(one - two) < max(1.0, 0.12 * one) and alike)

    def _confirmed(
        self, regions: list[tuple[Array, Array]], depth: Array, rest: Array, flow: Array, dt: float, now: Head
    ) -> list[Found]:
        kept, ready = [], []
        for box, own in regions:
            motion = np.median(rest[own], axis=0)
            away = float(np.median(depth[own]))
            velocity = now.R @ np.array([*(motion / np.diag(self._rig.left.K)[:2] * away / dt), 0.0])
            if np.linalg.norm(velocity) < SLOWEST:
                continue
            before = next((c for c in self._candidates if _shared(c.box, box) > 0.4), None)
            alike = before is not None and float(before.motion @ motion) > 0
            candidate = _Candidate(box, before.seen + 1 if before is not None and alike else 1, motion)
            if candidate.seen >= self._config.life.confirm_frames and not self._cut(box, depth, away):
                moved = np.tile(np.median(flow[own], axis=0), 2)  # the regions are those of the frame before
                u0, v0, u1, v1 = self._tight(box, depth, away) + moved
                ready.append(Found(np.array([[u0, v0], [u1, v0], [u1, v1], [u0, v1]]), velocity, away))
            else:
                kept.append(candidate)
        self._candidates = kept
        return ready

    def _cut(self, box: Array, depth: Array, away: float) -> bool:
        """Whether a thing in a box [u0, v0, u1, v1] is partly out of view, or behind something."""
        own = self._rig.left.K[0, 0] * self._rig.baseline / away  # px at the left that the right view lacks
        if box[0] < own + RIM or box[2] > depth.shape[1] - 1 - RIM:
            return True
        strip = max(BESIDE * (box[2] - box[0]), 2 * RIM)
        rows = slice(int(0.8 * box[1] + 0.2 * box[3]), int(0.2 * box[1] + 0.8 * box[3]) + 1)
        for edge in (box[0] - strip, box[2]):
            beside = depth[rows, max(int(edge), 0) : int(edge + strip) + 1]
            nearer = self._rig.left.K[0, 0] * self._rig.baseline / beside > own + max(1.0, 0.15 * own)
            if np.mean(nearer) > 0.5:
                return True
        return False

    def _tight(self, box: Array, depth: Array, away: float) -> Array:
        """The box [u0, v0, u1, v1] no wider than what lies as far away, `away` m: flow alone runs over outlines."""
        more = WIDER * (box[2:] - box[:2])
        low = np.maximum(np.floor(box[:2] - more), 0).astype(int)
        high = np.minimum(np.ceil(box[2:] + more), [depth.shape[1] - 1, depth.shape[0] - 1]).astype(int)
        disparity = self._rig.left.K[0, 0] * self._rig.baseline / depth[low[1] : high[1] + 1, low[0] : high[0] + 1]
        own = self._rig.left.K[0, 0] * self._rig.baseline / away
        near = np.abs(disparity - own) < max(1.0, 0.1 * own)
        inner = box - np.tile(low, 2)  # in the cut-out
        columns = _run(near[max(int(inner[1]), 0) : int(inner[3]) + 1].mean(axis=0), (inner[0] + inner[2]) / 2)
        left, right = np.array(columns) - 0.5 + low[0]
        if right - left <= KEPT * (box[2] - box[0]):
            return box
        # Below the feet the ground comes nearer at once.
        level = np.abs(disparity - own)[:, slice(*columns)] < max(0.5, 0.05 * own)
        bottom = _run(level.mean(axis=1), (inner[1] + inner[3]) / 2)[1] - 0.5 + low[1]
        below = box[3] - bottom
        return np.array([left, box[1], right, bottom if 0 < below < BELOW * (box[3] - box[1]) else box[3]])


def _run(share: Array, middle: float) -> tuple[int, int]:
    """First and one past the last of the places around the middle where a share is half of its largest or more.

    Gaps of a third are passed over: depth has holes.
    """
    full = share >= 0.5 * max(float(share.max(initial=0.0)), 1e-9)
    gap = np.ones(len(full) // 3 + 1, np.uint8)
    wide = np.pad(full, len(full)).astype(np.uint8)[None]
    full = np.asarray(cv2.morphologyEx(wide, cv2.MORPH_CLOSE, gap[None])[0, len(share) : 2 * len(share)] > 0)
    at = int(np.clip(round(middle), 0, len(full) - 1))
    before, after = np.flatnonzero(~full[:at]), np.flatnonzero(~full[at:])
    return int(before[-1]) + 1 if len(before) else 0, at + (int(after[0]) if len(after) else len(full) - at)


def _shared(box: Array, other: Array) -> float:
    inner = np.clip(np.minimum(box[2:], other[2:]) - np.maximum(box[:2], other[:2]), 0, None)
    return float(np.prod(inner) / max(min(np.prod(box[2:] - box[:2]), np.prod(other[2:] - other[:2])), 1e-9))
