"""How fast boxes go by the corners on them: what moves a box where neighbours hide its outline or lend it theirs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from visfuse_cli.maths.cameras import project
from visfuse_cli.maths.medians import median
from visfuse_cli.records import Array, GroundCamera
from visfuse_cli.vision import wireframe
from visfuse_cli.vision.points import Moves, window_px

LEAST = 3  # corners that tell a speed
CORNER_PX = 0.3  # noise of a corner from picture to picture
SURFACE = 0.3  # of a speed: corners lie before or behind the sides of a box, and some stay behind what is fast
MARGIN = 0.12  # of a silhouette's width: corners closer to its border may be those of what lies beside it
SETTLED = 0.1  # m/s: what stands may seem to go


def paces(camera: GroundCamera, pose: Array, size: Array, expected: Array, moves: Moves) -> tuple[Array, Array]:
    """Speed (N,) m/s along their headings and its deviation (N,) of boxes with pose (N, 3), size (N, 3) and an
    expected speed (N,); NaN of those with too few corners.

    A corner belongs to the side of a box that is nearest along its line of sight, at whose height it moves. Near the
    outline it tells little: where a vehicle of one colour meets what stands, the place where they meet goes slowly.
    """
    speed, sigma = np.full(len(pose), np.nan), np.full(len(pose), np.nan)
    if not len(moves.now) or not len(pose):
        return speed, sigma
    place, owner = _on_boxes(camera, pose, size, moves.now)
    ahead = np.stack([np.cos(pose[:, 2]), np.sin(pose[:, 2])], axis=-1)[owner]
    gone = np.zeros((len(place), 2))
    for _ in range(2):  # m on the ground for a pixel, half-way
        _, J = project(camera, place - np.column_stack([gone / 2, np.zeros(len(place))]))
        way_of = _inverse(J[:, :, :2])
        gone = np.einsum("nij,nj->ni", way_of, moves.now - moves.before)
    along = np.sum(gone * ahead, axis=1)
    aside = ahead[:, 0] * gone[:, 1] - ahead[:, 1] * gone[:, 0]
    noise = CORNER_PX * np.linalg.norm(np.einsum("ni,nij->nj", ahead, way_of), axis=1)
    good = (owner >= 0) & (np.abs(aside) < np.abs(along) + 3 * noise)
    good &= _well_inside(camera, pose, size, moves.now, owner)
    for k in range(len(pose)):
        mine = good & (owner == k)
        if np.count_nonzero(mine) < LEAST:
            continue
        each = along[mine] / moves.dt
        middle = median(each)
        spread = 1.5 * median(np.abs(each - middle))
        doubt = max(spread, median(noise[mine]) / moves.dt) / np.sqrt(len(each))
        surface = SURFACE * max(abs(middle), abs(expected[k]))
        speed[k], sigma[k] = middle, np.sqrt(doubt**2 + surface**2 + SETTLED**2)
    return speed, sigma


def _well_inside(camera: GroundCamera, pose: Array, size: Array, pixels: Array, owner: Array) -> NDArray[np.bool_]:
    """Which of the corners at pixels (n, 2) lie so far inside of the outline of their box that it alone moves them."""
    box = wireframe.projected(camera, pose, size)
    outline = wireframe.silhouette_edges(camera, pose, size)
    first, last = box[..., wireframe.EDGES[:, 0]], box[..., wireframe.EDGES[:, 1]]  # (2, N, 12)
    along, offset = (last - first)[:, owner], pixels.T[..., None] - first[:, owner]  # (2, n, 12)
    share = np.sum(offset * along, axis=0) / np.maximum(np.sum(along**2, axis=0), 1e-12)
    off = np.hypot(*(offset - np.minimum(np.maximum(share, 0), 1) * along))
    border = np.where(outline[owner], off, np.inf).min(axis=1)
    margin = np.minimum(window_px(camera), MARGIN * np.ptp(box[0], axis=1))
    return np.asarray((owner >= 0) & (border > margin[owner]))


def _inverse(J: Array) -> Array:
    """Inverses of matrices (n, 2, 2), NaN of those that have none."""
    det = J[:, 0, 0] * J[:, 1, 1] - J[:, 0, 1] * J[:, 1, 0]
    flipped = np.stack([J[:, 1, 1], -J[:, 0, 1], -J[:, 1, 0], J[:, 0, 0]], axis=-1).reshape(-1, 2, 2)
    return np.asarray(flipped / np.where(np.abs(det) > 1e-12, det, np.nan)[:, None, None])


def _on_boxes(camera: GroundCamera, pose: Array, size: Array, pixels: Array) -> tuple[Array, Array]:
    """Where (n, 3) m the lines of sight through pixels (n, 2) first meet a box, and which one (n,); -1: none."""
    H, centre = camera.ground.ground_from_image, camera.centre
    foot = pixels @ H[:, :2].T + H[:, 2]
    sight = np.column_stack([foot[:, :2] / foot[:, 2:] - centre[:2], np.full(len(pixels), -centre[2])])
    c, s = np.cos(pose[:, 2, None]), np.sin(pose[:, 2, None])
    off = centre[:2] - pose[:, :2]
    # From the camera, and on along the lines of sight, in the axes of each box: (N, 1) and (N, n).
    from_camera = [c * off[:, :1] + s * off[:, 1:], c * off[:, 1:] - s * off[:, :1], np.full_like(c, centre[2])]
    along_sight = [c * sight[:, 0] + s * sight[:, 1], c * sight[:, 1] - s * sight[:, 0], sight[:, 2]]
    faces = [(-size[:, 0] / 2, size[:, 0] / 2), (-size[:, 1] / 2, size[:, 1] / 2), (0 * size[:, 2], size[:, 2])]
    enters, leaves = np.full((len(pose), len(pixels)), -np.inf), np.full((len(pose), len(pixels)), np.inf)
    for start, way, (low, high) in zip(from_camera, along_sight, faces, strict=True):
        way = np.where(np.abs(way) < 1e-9, 1e-9, way)
        one, other = (low[:, None] - start) / way, (high[:, None] - start) / way
        enters = np.maximum(enters, np.minimum(one, other))
        leaves = np.minimum(leaves, np.maximum(one, other))
    meets = np.where((enters <= leaves) & (enters > 0), enters, np.inf)
    owner = np.argmin(meets, axis=0)
    nearest = meets[owner, np.arange(len(pixels))]
    place = centre + np.where(np.isfinite(nearest), nearest, 0.0)[:, None] * sight
    return place, np.where(np.isfinite(nearest), owner, -1)
