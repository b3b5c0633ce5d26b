"""What a finished track was: all its sightings adjusted along the path, and the speed they tell."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from visfuse_cli.facing import cloud, free
from visfuse_cli.facing.adjust import ALONG, RIGHT, SPEED, UP, Adjusted, Rules, Sightings, adjust, slopes
from visfuse_cli.facing.front import FACING, LATERAL, VERTICAL, S, Target, V, drift
from visfuse_cli.maths.paths import Way, through
from visfuse_cli.maths.planes import in_right, projected, triangulated
from visfuse_cli.records import Array, Gaussian

Z95 = 1.959963984540054
NARROWEST = 1e-9  # m^2 and m^2/s^2 of a cloud of particles
SHOWN = 0.2  # of its own height, or of the logarithm of it: what a moving thing changes in the picture
ALIKE = 0.8  # median correlation
USUAL_SIGMA, USUAL_RELIEF, USUAL_SPEED = 0.06, 0.1, 15.0
FEWEST = 2  # pieces an instant: with fewer the whole patch stands for one
STEP = 0.01  # m, of the numerical derivatives
DRIFT_SPEED = 0.05  # m/s across the path
PATH_SPEED_SHARE, TURN_SHARE = (
    0.001,
    0.003,
)  # of the speed: what the path's own direction may add, and each rad of a bend
PIXELS = ("left", "right", "left_cov", "across_cov")
PLACE = [ALONG, RIGHT, UP]


@dataclass(frozen=True, slots=True)
class Settled:
    """A finished track over T instants in the left camera's frame: belief of position and velocity (T, 6), and so on.

    speed and speed_sigma (T,) m/s; measured (T,); summary speed with its deviation over `distance` m.
    """

    id: int
    frame: list[int]
    t: Array
    belief: Gaussian
    speed: Array
    speed_sigma: Array
    measured: Array
    quads: list[dict[str, Array]]
    mean_speed: float
    mean_sigma: float
    distance: float
    noise: float
    sigma_v: float
    relief: float
    way: Way
    ended_by: str
    nis: list[float]  # of the filter that ran forward: normalised innovations squared of `nis_dof` numbers each
    nis_dof: int = 5


def conclude(target: Target) -> Settled | None:
    """Settle a track; None where it was measured in too few frames, or found unaided and did not move."""
    life = target.config.life
    if len(target.looks) < max(life.min_frames, life.min_share * len(target.causal)):
        return None
    if not target.on_path and target.config.filter.path_constraint:
        target = _with_way(target)
    t = np.array([look.t for look in target.looks])
    start = _start(target, t)
    sigma_v = target.config.filter.sigma_v
    try:
        adjusted = adjust(target.rig, target.way, _sightings(target, t), _rules(target, start), sigma_v, start)
    except np.linalg.LinAlgError:  # sightings that fit no motion at all
        return None
    if not np.isfinite(adjusted.states).all():
        return None
    settled = _settled(target, t, adjusted)
    if not target.given and not _moved(target, settled):
        return None
    return settled if target.config.smooth else _causal(target, settled)


def _rules(target: Target, start: Array) -> Rules:
    """What is known of the target before its sightings are looked at; what is slow drifts less."""
    lateral, vertical = drift(target)
    speed = abs(float(start[0, SPEED]))
    most = target.config.filter.free_share * 0.2 * speed
    return Rules(
        lateral=max(min(lateral, most), 1e-5),
        vertical=max(min(vertical, most / 2), 1e-5),
        sigma_v=USUAL_SIGMA,
        relief=USUAL_RELIEF,
        height=float(np.linalg.norm(target.shape.corners[3] - target.shape.corners[0])),
        anchor=target.looks[0].quads["left"].mean(axis=0),
        pace=float(np.clip(speed / USUAL_SPEED, 0.01, 1.0)),
    )


def _moved(target: Target, settled: Settled) -> bool:
    """Whether what was found unaided went anywhere, in space and in the picture, and looked like itself all the way."""
    place = settled.belief.mean[:, :3]
    net = float(np.linalg.norm(place[-1] - place[0]))
    first, last = target.looks[0].z, target.looks[-1].z
    size = np.exp(first[2])
    shown = max(float(np.linalg.norm(last[:2] - first[:2])) / size, abs(float(last[2] - first[2])))
    alike = float(np.median([look.correlation for look in target.looks]))
    return net > target.config.life.min_distance and shown > SHOWN and alike > ALIKE


def _with_way(target: Target) -> Target:
    """The same measurements, taken in along the path that they themselves lie on."""
    rig = target.rig
    z = np.stack([look.z for look in target.looks])
    points = triangulated(rig, z[:, :2], z[:, 3:])
    spread = np.array([look.R[3, 3] + look.R[0, 0] - 2 * look.R[0, 3] for look in target.looks])
    sigma = points[:, 2] ** 2 / (rig.left.K[0, 0] * rig.baseline) * np.sqrt(spread + 0.05**2)
    return cloud.again(target, through(points, sigma, 25.0))


def _sightings(target: Target, t: Array) -> Sightings:
    """All sightings of pieces that were seen more than once, in one row; of the whole patch where pieces are few."""
    each = [look.seen for look in target.looks]
    piece = np.concatenate([seen.pieces for seen in each]).astype(np.intp)
    frame = np.repeat(np.arange(len(each)), [len(seen.pieces) for seen in each])
    often = np.bincount(piece, minlength=1)[piece] > 1
    if np.count_nonzero(often) < FEWEST * len(t):
        return _whole(target, t)
    _, piece = np.unique(piece[often], return_inverse=True)
    pixels = [np.concatenate([getattr(seen, name) for seen in each])[often] for name in PIXELS]
    return Sightings(t, frame[often], piece, *pixels)


def _whole(target: Target, t: Array) -> Sightings:
    """The whole patch as if it were one piece."""
    z, R = (np.stack([getattr(look, name) for look in target.looks]) for name in ("z", "R"))
    index = np.arange(len(t), dtype=np.intp)
    return Sightings(t, index, 0 * index, z[:, :2], z[:, 3:], R[:, :2, :2], R[:, 3:, 3:] - R[:, :2, :2])


def _start(target: Target, t: Array) -> Array:
    """States (T, 4) of the measured places, roughly."""
    z = np.stack([look.z for look in target.looks])
    points = triangulated(target.rig, z[:, :2], z[:, 3:])
    s = np.array([target.way.nearest(point) for point in points])
    place, axes = target.way.frame(s)
    off = np.einsum("tab,ta->tb", axes, points - place)
    speed = np.polyfit(t - t[0], s, 1)[0]
    return np.column_stack([s, np.full(len(t), speed), off[:, 1:]])


def _settled(target: Target, t: Array, adjusted: Adjusted) -> Settled:
    """Positions, velocities and the mean speed, with what is not known of them."""
    states, T = adjusted.states, len(t)
    blocks = adjusted.cov.reshape(T, 4, T, 4)
    each = np.arange(T)
    aside = slopes(t, states[:, [RIGHT, UP]])
    belief, stretch = _belief(target.way, states[:, PLACE], states[:, SPEED], aside, blocks[each, :, each, :])
    steps = np.diff(states[:, PLACE], axis=0)
    steps[:, 0] *= (stretch[1:] + stretch[:-1]) / 2
    way = float(np.sum(np.linalg.norm(steps, axis=1)))
    duration = float(t[-1] - t[0])
    ends = blocks[[0, -1]][:, ALONG][:, [0, -1], ALONG] * float(np.mean(stretch)) ** 2
    variance = float(np.array([-1.0, 1.0]) @ ends @ np.array([-1.0, 1.0]))
    mean_speed = way / duration
    return Settled(
        id=target.id,
        frame=[look.frame for look in target.looks],
        t=t,
        belief=belief,
        speed=np.linalg.norm(belief.mean[:, 3:], axis=1),
        speed_sigma=np.sqrt(blocks[each, SPEED, each, SPEED]) * stretch,
        measured=np.ones(T, dtype=bool),
        quads=_carried(target, states[:, PLACE]) if target.given else [look.quads for look in target.looks],
        mean_speed=mean_speed,
        mean_sigma=float(
            np.hypot(np.sqrt(max(variance, 0.0)) / duration, _path_share(target.way, states) * mean_speed)
        ),
        distance=way,
        noise=adjusted.noise,
        sigma_v=adjusted.sigma_v,
        relief=adjusted.relief,
        way=target.way,
        ended_by=target.ended_by,
        nis=target.nis,
    )


def _path_share(way: Way, states: Array) -> float:
    """What share of the speed the path may be wrong by, between the first and last of states (T, 4)."""
    ends = way.frame(states[[0, -1], ALONG])[1][..., 0]
    return float(np.hypot(PATH_SPEED_SHARE, TURN_SHARE * np.arccos(np.clip(ends[0] @ ends[1], -1.0, 1.0))))


def _carried(target: Target, place: Array) -> list[dict[str, Array]]:
    """The first quad as the vehicle carries it, in both views; as it was seen first, so it is drawn always."""
    rig, first = target.rig, target.looks[0].quads["left"]
    point = _middle(target.way, place)
    rays = np.column_stack([first, np.ones(4)]) @ np.linalg.inv(rig.left.K).T
    axes = target.way.frame(place[:, 0])[1]
    ahead = axes[0, :, 0] @ point[0] / np.linalg.norm(point[0])
    normal = axes[0, :, 0] if abs(ahead) > FACING else np.array([0.0, 0.0, 1.0])
    corners = (rays * (normal @ point[0] / (rays @ normal))[:, None] - point[0]) @ axes[0]
    moved = point[:, None] + corners @ np.swapaxes(axes, 1, 2)
    left, right = projected(rig.left.K, moved), projected(rig.right.K, in_right(rig, moved))
    return [{"left": a, "right": b} for a, b in zip(left, right, strict=True)]


def _belief(way: Way, place: Array, speed: Array, aside: Array, cov: Array) -> tuple[Gaussian, Array]:
    """Position and velocity (T, 6) of places along, right and up (T, 3), speeds (T,) along and (T, 2) aside, and the
    way's stretch (T,).

    cov (T, 4, 4) is that of arc length, speed, drift right and up. Beside a curved path the way is longer, or shorter.
    """
    J = _motion(way, place)
    full = np.zeros((len(place), 6, 4))
    full[:, :3, PLACE] = J
    full[:, 3:, SPEED] = J[:, :, 0]
    stretch = np.linalg.norm(J[:, :, 0], axis=1)
    along = J[:, :, 0] / stretch[:, None]
    both = full @ cov @ np.swapaxes(full, 1, 2)
    both[:, 3:, 3:] += DRIFT_SPEED**2 * (np.eye(3) - along[:, :, None] * along[:, None, :])
    velocity = J[:, :, 0] * speed[:, None] + np.einsum("tab,tb->ta", J[:, :, 1:], aside)
    mean = np.concatenate([_middle(way, place), velocity], axis=1)
    return Gaussian(mean, (both + np.swapaxes(both, 1, 2)) / 2), stretch


def _middle(way: Way, place: Array) -> Array:
    """Points (..., 3) m of places (..., 3) along, right and up."""
    point, axes = way.frame(place[..., 0])
    return np.asarray(point + place[..., 1, None] * axes[..., 1] + place[..., 2, None] * axes[..., 2])


def _motion(way: Way, place: Array) -> Array:
    """d point / d place (T, 3, 3)."""
    tried = place[:, None, :] + STEP * np.concatenate([np.eye(3), -np.eye(3)])[None]
    point = _middle(way, tried)
    return np.swapaxes((point[:, :3] - point[:, 3:]) / (2 * STEP), 1, 2)


def mean_pair(speed: Array, sigma: Array, smooth: bool) -> tuple[float, float]:
    """The speed of a track and its deviation: the mean of smoothed speeds (T,), the last of causal ones."""
    if smooth:
        return float(speed.mean()), float(sigma.mean())
    return float(speed[-1]), float(sigma[-1])


def _causal(target: Target, settled: Settled) -> Settled:
    """The particles' own output, instant by instant, in place of the smoothed states."""
    kept = [entry for entry in target.causal if entry[1] <= settled.t[-1] + 1e-9]
    mean = np.stack([belief.mean for _, _, belief, _ in kept])
    cov = np.stack([belief.cov for _, _, belief, _ in kept])
    if target.free:
        order = free.KINEMATIC
        belief = Gaussian(mean[:, order], cov[:, order][:, :, order])
    else:
        order = [S, V, LATERAL, VERTICAL]
        place = mean[:, [S, LATERAL, VERTICAL]]
        still = np.zeros((len(mean), 2))
        belief, _ = _belief(target.way, place, mean[:, V], still, cov[:, order][:, :, order])
    # A cloud of which one particle is left has no width of its own, but for rounding.
    belief = Gaussian(belief.mean, belief.cov + NARROWEST * np.eye(6))
    speed = np.linalg.norm(belief.mean[:, 3:], axis=1)
    along = belief.mean[:, 3:] / np.maximum(speed, 1e-9)[:, None]
    sigma = np.sqrt(np.einsum("ta,tab,tb->t", along, belief.cov[:, 3:, 3:], along))
    mean_speed, mean_sigma = mean_pair(speed, sigma, False)
    quads = {look.frame: look.quads for look in target.looks}
    return replace(
        settled,
        frame=[entry[0] for entry in kept],
        t=np.array([entry[1] for entry in kept]),
        belief=belief,
        speed=speed,
        speed_sigma=sigma,
        mean_speed=mean_speed,
        mean_sigma=mean_sigma,
        measured=np.array([entry[3] for entry in kept]),
        quads=[quads.get(entry[0], {}) for entry in kept],
    )
