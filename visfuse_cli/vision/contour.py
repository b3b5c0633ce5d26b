"""The outline of a vehicle where it is expected: a search across each edge of its projected wireframe.

The picture is one of labels (background, shadow, foreground). Along the normal of each silhouette edge the place is
taken where most of what is inside moved and most of what is outside did not, so that holes in a region, a neighbour
that touches it or a shadow beside it do not move the outline (Lou 2002, sec. 2: point-to-segment distance).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from visfuse_cli.records import Array, GroundCamera, Image
from visfuse_cli.vision.background import FOREGROUND, SHADOW
from visfuse_cli.vision.labels import Labels
from visfuse_cli.vision.lens import distort_points
from visfuse_cli.vision.wireframe import DIRECTIONS, EDGES, Outlines, downwards, projected, silhouette_edges

STEPS = 12  # places either side of the expected edge
SURE = 4  # places either side of the found one that must agree
NOWHERE = -128  # fewer votes than any border has
CLEAR_PX = 2.5  # between a border and the background outside it
SOLID = 0.8  # of what lies inside a border must be paint to take what lies outside for shadow
GROUND_EDGES = 4  # the first of the EDGES lie on the ground
SILL_M, SILL_STEPS = 0.6, 24  # m below the border, and places there, in which what else is a vehicle's is looked for
STEEP = 0.4  # cosine of a border's normal and what is down in the picture, at least
OPEN = 0.7  # of a profile that must be visible to expect a border in it
BEYOND = 0.12  # of a silhouette's width: how far out the border of a box that is too small may lie
LEAST = 0.1  # of a border or an area that must be visible to say anything about it
OUTSIDE, OUTSIDE_PX = 0.06, (2.5, 10.0)  # of a silhouette's width, px: what lies so far outside of it is around it
_RADII = np.sqrt((np.arange(5) + 0.5) / 5)  # from the middle of a silhouette to its border: equal areas


def owners(camera: GroundCamera, pose: Array, size: Array) -> Image:
    """Whose silhouette each pixel (H, W) belongs to: 1 + the row of the nearest box there, 0 of none, 255 at most."""
    width, height = camera.image_size
    mask = np.zeros((height, width), np.uint8)
    distance = np.hypot(*(pose[:, :2] - camera.centre[:2]).T)
    hulls = hulls_of(camera, projected(camera, pose, size))
    for k in np.argsort(-distance):
        if len(hulls[k]):
            cv2.fillConvexPoly(mask, hulls[k], int(min(k + 1, 255)))
    return mask


def hulls_of(camera: GroundCamera, pixels: Array) -> list[np.ndarray]:
    """The hulls (k, 2) of N times n points (2, N, n) px as the footage shows them, rounded; empty where any is NaN."""
    points = pixels.transpose(1, 2, 0)
    known = np.asarray(np.isfinite(points).all(axis=(1, 2)))
    points = np.where(known[:, None, None], points, 0.0)
    if camera.ground.lens is not None:
        points = distort_points(points.reshape(-1, 2), camera.ground.lens).reshape(points.shape)
    whole = np.round(np.minimum(np.maximum(points, -1e4), 1e4)).astype(np.int32)
    return [cv2.convexHull(each) if sure else each[:0] for each, sure in zip(whole, known, strict=True)]


@dataclass(frozen=True, slots=True)
class Look:
    """What was seen of N boxes, as shares (N,) of what nothing hides; NaN where nearly everything is hidden.

    border: of the border, what was found; likeness: the same, of what does not lie in the midst of paint; clear: of
    the found border, what has background outside and not shadow or paint; foot: of the border on the ground, what was
    found; shaded: of the found border on the ground, what stands in shadow; moved: of the area, what differs from the
    background; paint: of the area, what differs and is no shadow; open: of the area, what is in view.
    """

    outlines: Outlines
    border: Array
    likeness: Array
    clear: Array
    foot: Array
    shaded: Array
    moved: Array
    paint: Array
    open: Array

    @property
    def apart(self) -> Array:
        """Share (N,) of the border that does not lie in the midst of paint."""
        return self.border / np.maximum(self.likeness, 1e-9)

    def __getitem__(self, which: object) -> Look:
        return Look(*(getattr(self, name)[which] for name in self.__dataclass_fields__))

    @staticmethod
    def joined(looks: Sequence[Look]) -> Look:
        """What several looks saw, in their order."""
        names = [name for name in Look.__dataclass_fields__ if name != "outlines"]
        outlines = Outlines.joined([look.outlines for look in looks])
        return Look(outlines, *(np.concatenate([getattr(look, name) for look in looks]) for name in names))


@dataclass(frozen=True, slots=True)
class Sight:
    """One picture's labels, whose silhouette is nearest in each pixel (H, W) (see `owners`), and whether it is sunny:
    shadows are then told by their darkness."""

    labels: Labels
    owner: Image
    sunny: bool = False


@dataclass(frozen=True, slots=True)
class Profiles:
    """What was seen across the borders of N boxes: the outlines, and of the K profiles of each (N, K, S) what is known
    and what is paint; which end on the ground (N, K), and which have background outside, not shadow or paint (N, K).

    `middle` (2, N, 1), `at` and `normal` (2, N, K) are the places, px, as in `_places`.
    """

    outlines: Outlines
    middle: Array
    at: Array
    normal: Array
    known: NDArray[np.bool_]
    paint: NDArray[np.bool_]
    ground: NDArray[np.bool_]
    clear: NDArray[np.bool_]
    dark: NDArray[np.bool_]


def profiles(
    sights: Sequence[Sight], code: NDArray[np.intp], camera: GroundCamera, pose: Array, size: Array, reach: Array
) -> Profiles:
    """Look for the outlines of N boxes with pose (N, 3) and size (N, 3), at most `reach` (N,) px off.

    All of them are looked for in one of `sights`, or each in its own; `code` (N,) is what the boxes are called among
    the owners there, 0 when they are not.
    """
    middle, at, normal, edge, share, total = _places(camera, pose, size)
    offset = reach[:, None] * np.linspace(-1, 1, 2 * STEPS + 1)  # (N, S)
    along = at[..., None] + normal[..., None] * offset[:, None]  # (2, N, K, S)
    label, whose, inside = _look(sights, camera, along)
    known = inside & ((whose == 0) | (whose == code[:, None, None]))
    paint = known & (label == FOREGROUND)
    found = _border(known, np.stack([paint, known & (label > 0)]), offset)  # shadow is outside, or it is grey paint
    nearer = np.abs(found[1]) < np.where(np.isnan(found[0]), np.inf, np.abs(found[0]))
    nearest = np.where(nearer, found[1], found[0])
    ground = edge < GROUND_EDGES
    under = _stands_in_shadow(paint, known, offset, found, ground)
    under |= np.array([[sight.sunny] for sight in sights]) & np.isfinite(found[0])
    nearest = np.where(under, found[0], nearest)
    valid = np.isfinite(nearest)
    support = _dot(normal, at) + np.where(valid, nearest, 0.0)
    rows = np.ascontiguousarray(np.moveaxis(normal, 0, -1))
    none, unknown = np.zeros(len(pose), dtype=bool), np.full(valid.shape, np.nan)
    outlines = Outlines(rows, support, EDGES[edge], share, valid, none, total / np.pi, unknown, unknown)
    alone = np.abs(found[1] - nearest) < CLEAR_PX
    return Profiles(outlines, middle, at, normal, known, paint, ground, valid & (under | alone), valid & ~alone)


def search(
    sights: Sequence[Sight],
    code: NDArray[np.intp],
    camera: GroundCamera,
    pose: Array,
    size: Array,
    reach: Array,
    beyond: bool = False,
) -> Look:
    """What is seen of N boxes: outlines as in `profiles`, and how much of border and area is as it was expected.

    With `beyond`, of boxes in one sight, a border in the midst of paint that is no other box's is looked for further
    out, as the box is too small.
    """
    across = profiles(sights, code, camera, pose, size, reach)
    valid, ground = across.outlines.valid, across.ground
    seen = np.count_nonzero(across.known, axis=2)
    in_view = seen / across.known.shape[2] > OPEN
    amidst = np.count_nonzero(across.paint, axis=2) > SOLID * seen  # nothing but paint: another vehicle is beside it
    told = in_view & (valid | ~amidst)
    outlines = across.outlines
    if beyond:
        missing, far = in_view & ~valid & amidst, BEYOND * outlines.width
        again = np.flatnonzero(missing.any(axis=1) & (far > reach))
        wide = profiles(sights, code[again], camera, pose[again], size[again], far[again]).outlines
        outlines = _completed(outlines, again, missing[again], wide)
    dark, paint = _beneath(sights, code, camera, pose, size, outlines, across)
    outlines = replace(outlines, dark=dark, paint=paint)
    label, whose, inside = _look(sights, camera, _spokes(across.middle, across.at, _RADII))
    own = inside & (whose == code[:, None, None])
    area = _areas(across.middle, across.at, across.normal)[..., None] * np.ones(len(_RADII))
    area /= np.maximum(area.sum(axis=(1, 2), keepdims=True), 1e-9)
    return Look(
        outlines,
        border=_share(valid & in_view, in_view, 1 / DIRECTIONS),
        likeness=_share(valid & in_view, told, 1 / DIRECTIONS),
        clear=_share(across.clear, valid, 1 / DIRECTIONS),
        foot=_share(valid & in_view & ground, in_view & ground, 1 / DIRECTIONS),
        shaded=_share(across.dark & ground, valid & ground, 1 / DIRECTIONS),
        moved=_share(own & (label > 0), own, area),
        paint=_share(own & (label == FOREGROUND), own, area),
        open=np.sum(own * area, axis=(1, 2)),
    )


def _beneath(
    sights: Sequence[Sight],
    code: NDArray[np.intp],
    camera: GroundCamera,
    pose: Array,
    size: Array,
    outlines: Outlines,
    across: Profiles,
) -> tuple[Array, Array]:
    """What lies below the border on the ground: `dark` and `paint` (N, K) m, see `Outlines`."""
    down = downwards(camera, pose, size)
    steep = _dot(across.normal, down[..., None])  # px along the normal for a metre down
    border = across.at + across.normal * (outlines.support - _dot(across.normal, across.at))
    depth = (np.arange(SILL_STEPS) + 1) * (SILL_M / SILL_STEPS)
    label, whose, inside = _look(sights, camera, border[..., None] + (across.normal * steep)[..., None] * depth)
    known = inside & ((whose == 0) | (whose == code[:, None, None]))
    dark = known & (label == SHADOW)
    end = np.argmin(dark, axis=-1)[..., None]  # the first place that is not
    found = (end > 0) & np.take_along_axis(known & (label == 0), end, axis=-1)
    height = np.where(found, depth[end] - depth[0] / 2, np.where(end > 0, np.inf, np.nan))[..., 0]
    asked = outlines.valid & across.ground & (steep > STEEP * _length(down)[:, None])
    painted = known & (label == FOREGROUND)
    last = SILL_STEPS - 1 - np.argmax(painted[..., ::-1], axis=-1)
    told = known.all(axis=-1) & (last < SILL_STEPS - 1)
    low = np.where(painted.any(axis=-1), np.where(told, depth[last] + depth[0] / 2, np.inf), 0.0)
    return np.where(asked, np.where(dark.all(axis=-1), np.inf, height), np.nan), np.where(asked, low, np.nan)


def _completed(outlines: Outlines, which: NDArray[np.intp], missing: NDArray[np.bool_], wide: Outlines) -> Outlines:
    """N outlines, `which` (n,) of them with the rows that were `missing` (n, K) from those that reach further out."""
    found = wide.valid & missing
    support, valid = outlines.support.copy(), outlines.valid.copy()
    support[which] = np.where(found, wide.support, support[which])
    valid[which] |= found
    return replace(outlines, support=support, valid=valid)


@dataclass(frozen=True, slots=True)
class Fill:
    """A quick look at N boxes (N,): px^2 of the silhouette; shares of it that are in view and free, that differ there
    from the background and that are paint; and share of what lies just outside that is background or shadow."""

    area: Array
    open: Array
    moved: Array
    paint: Array
    clear: Array


def fill(sight: Sight, camera: GroundCamera, pose: Array, size: Array) -> Fill:
    """What N boxes with pose (N, 3) and size (N, 3) are filled with, among the owners there."""
    middle, at, normal, _, _, total = _places(camera, pose, size)
    label, whose, inside = _look([sight], camera, _spokes(middle, at[:, :, ::2], _RADII[1::2]))
    free = inside & (whose == 0)
    area = _areas(middle, at, normal)
    weight = area[:, ::2, None] * free
    whole = np.maximum(weight.sum(axis=(1, 2)), 1e-9)
    off = np.clip(OUTSIDE * total / np.pi, *OUTSIDE_PX)
    around, whose, inside = _look([sight], camera, at + off[:, None] * normal)
    told = inside & (whose == 0)
    # half of what a place's border length times its distance from the middle sums up to
    return Fill(
        area=area.sum(axis=1) * total / DIRECTIONS / 2,
        open=free.mean(axis=(1, 2)),
        moved=np.sum(weight * (label > 0), axis=(1, 2)) / whole,
        paint=np.sum(weight * (label == FOREGROUND), axis=(1, 2)) / whole,
        clear=np.sum(told & (around != FOREGROUND), axis=1) / np.maximum(told.sum(axis=1), 1),
    )


def _places(
    camera: GroundCamera, pose: Array, size: Array
) -> tuple[Array, Array, Array, NDArray[np.intp], Array, Array]:
    """Middle (2, N, 1) px of each silhouette, and K places spread evenly along its border.

    at (2, N, K) px and outward normal (2, N, K) of the places, which of the EDGES (N, K) each lies on and how far along
    it (N, K), and the border's length (N,) px. Coordinates come first: numpy is slow along short last axes.
    """
    pixels = projected(camera, pose, size)
    pixels = np.where(np.isnan(pixels), -1e4, pixels)
    first, last = pixels[..., EDGES[:, 0]], pixels[..., EDGES[:, 1]]  # (2, N, 12)
    length = _length(last - first) * silhouette_edges(camera, pose, size)
    total = np.cumsum(length, axis=1)
    places = (np.arange(DIRECTIONS) + 0.5) / DIRECTIONS * total[:, -1:]
    edge = np.minimum(np.count_nonzero(places[:, :, None] > total[:, None], axis=2), len(EDGES) - 1)  # (N, K)
    rows = np.arange(len(pose))[:, None]
    share = (places - total[rows, edge]) / np.maximum(length[rows, edge], 1e-9) + 1
    share = np.minimum(np.maximum(share, 0), 1)
    a, b = first[:, rows, edge], last[:, rows, edge]
    at = a + share * (b - a)
    normal = np.stack([b[1] - a[1], a[0] - b[0]])
    normal /= np.maximum(_length(normal), 1e-9)
    middle = pixels.mean(axis=2)[..., None]
    normal *= np.where(_dot(normal, at - middle) < 0, -1.0, 1.0)
    return middle, at, normal, edge, share, total[:, -1]


def _dot(a: Array, b: Array) -> Array:
    """Products (...) of plane vectors (2, ...)."""
    return a[0] * b[0] + a[1] * b[1]


def _length(a: Array) -> Array:
    """Lengths (...) of plane vectors (2, ...)."""
    return np.sqrt(_dot(a, a))


def _spokes(middle: Array, at: Array, radii: Array) -> Array:
    """Points (2, N, K, R) px between the middle (0) and the border (1)."""
    return middle[..., None] + radii * (at - middle)[..., None]


def _areas(middle: Array, at: Array, normal: Array) -> Array:
    """Distance (N, K) px from the middle to each place's edge: its share of the area."""
    return np.abs(_dot(normal, at - middle))


def _stands_in_shadow(
    paint: np.ndarray, known: np.ndarray, offset: Array, found: Array, ground: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Which rows (N, K) on `ground` edges end in the shadow a vehicle stands in: above it there is solid paint.

    A grey vehicle looks like shadow too, but then its paint is no more than its windows, lamps and wheels.
    """
    both = ground & (found[1] - found[0] > CLEAR_PX)
    if not both.any():
        return both
    inside = both[..., None] & (offset[:, None] < np.where(both, found[0], 0.0)[..., None])
    solid = np.count_nonzero(inside & paint, axis=(1, 2)) > SOLID * np.count_nonzero(inside & known, axis=(1, 2))
    return np.asarray(both & solid[:, None])


def _share(part: np.ndarray, whole: np.ndarray, weight: Array | float) -> Array:
    """Weighted share (N,) of `part` in `whole` (N, ...); NaN where `whole` is nearly nothing."""
    axes = tuple(range(1, part.ndim))
    every = np.sum(whole * weight, axis=axes)
    return np.where(every > LEAST, np.sum(part * weight, axis=axes) / np.maximum(every, 1e-9), np.nan)


def _look(sights: Sequence[Sight], camera: GroundCamera, points: Array) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Labels, owners and whether they lie in the picture, at points (2, N, ...) px of one sight or of N.

    What labels and owners are told outside of the picture means nothing.
    """
    if camera.ground.lens is not None:
        points = distort_points(points.reshape(2, -1).T, camera.ground.lens).T.reshape(points.shape)
    height, width = sights[0].owner.shape
    u, v = np.rint(np.minimum(np.maximum(points, -2), 1e5)).astype(np.intp)
    inside = (u > 0) & (u < width - 1) & (v > 0) & (v < height - 1)
    place = v * width + u
    if len(sights) == 1:
        return sights[0].labels.at(place), sights[0].owner.take(place, mode="clip"), inside
    label = np.stack([sight.labels.at(place[k]) for k, sight in enumerate(sights)])
    whose = np.stack([sight.owner.take(place[k], mode="clip") for k, sight in enumerate(sights)])
    return label, whose, inside


def _border(known: NDArray[np.bool_], moved: NDArray[np.bool_], offset: Array) -> Array:
    """Where (M, N, K) px, along profiles (N, K, S) at offsets (N, S) px, the border lies; NaN: nowhere.

    Of what is `known` (N, K, S) each of M ways to look says what `moved` (M, N, K, S). A place votes +1 for inside
    where it moved, -1 for outside where not, and not at all where it is not known.
    """
    votes = 2 * moved.view(np.int8) - known.view(np.int8)
    total = np.cumsum(votes, axis=-1, dtype=np.int8)  # of fewer than 2 * STEPS + 2 places
    before = total[..., SURE - 1 :].copy()
    before[..., 1:] -= total[..., :-SURE]  # sums of SURE places that end here
    first, last = SURE - 1, total.shape[-1] - SURE - 1  # a border lies after place c, first <= c <= last
    inner = before[..., : last - first + 1]
    outer = before[..., SURE : SURE + last - first + 1]
    sure = (inner >= SURE // 2) & (outer <= -SURE // 2)
    split = np.where(sure, 2 * total[..., first : last + 1] - total[..., -1:], np.int8(NOWHERE))
    middle = (offset[:, first : last + 1] + offset[:, first + 1 : last + 2]) / 2
    there = middle[np.arange(len(middle))[:, None], np.argmax(split, axis=-1)]
    return np.where(sure.any(axis=-1), there, np.nan)
