"""One vehicle's front: particles over its pose along the path, the patch aligned in both views, what was measured."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from visfuse_cli.facing.settings import StereoConfig
from visfuse_cli.maths import particles
from visfuse_cli.maths.paths import Way
from visfuse_cli.maths.planes import in_right, on_plane, projected, triangulated
from visfuse_cli.records import Array, Gaussian, StereoRig
from visfuse_cli.vision import patches
from visfuse_cli.vision.patches import Alignment, Grey, Template
from visfuse_cli.vision.pieces import Pieces, Seen

S, V, LATERAL, VERTICAL, SIZE = range(5)  # of a state: arc length m, speed m/s, drift m, log size
AGAIN = 0.55  # of the effective number: below, the particles are drawn anew
SIGN_FRAMES = 2  # frames after which the direction of travel is decided
FOUND_SHARE = 0.4  # how far the speed of what was found unaided may be off
FACING, FACING_FOUND = 0.4, 0.97  # cosines of the way to the line of sight from which on its front is seen
TRUST = 8.0  # times an alignment's own covariance: neighbouring samples share their errors
STRAYED = 60.0  # squared deviations of the best particle from the patch that was found
ACROSS_STRETCH = 0.03  # what a front that is not quite flat, or not quite so turned, differs by across the views
SETTLE_S, ALIKE_SIZE = 1.0, 0.7  # of a patch found unaided on the region that moves; largest log of their sizes' ratio
TEMPER = 4.0
BLUR_PX, BLUR_STRETCH = 0.3, 0.01
FLOOR_PX, FLOOR_STRETCH = 0.02, 0.0015


@dataclass(frozen=True, slots=True)
class Shape:
    """The front: corners (4, 3) m along the path, to the right of it and up, from its middle, at log size 0."""

    corners: Array

    def points(self, way: Way, states: Array) -> Array:
        """Corners (..., 4, 3) m of states (..., 5)."""
        point, axes = way.frame(states[..., S])
        middle = point + states[..., LATERAL, None] * axes[..., 1] + states[..., VERTICAL, None] * axes[..., 2]
        scaled = np.exp(states[..., SIZE])[..., None, None] * self.corners
        return np.asarray(middle[..., None, :] + scaled @ np.swapaxes(axes, -1, -2))


def middle(way: Way, states: Array) -> Array:
    """The front's middle (..., 3) m of states (..., 5)."""
    point, axes = way.frame(states[..., S])
    return np.asarray(point + states[..., LATERAL, None] * axes[..., 1] + states[..., VERTICAL, None] * axes[..., 2])


def expected(rig: StereoRig, way: Way, shape: Shape, states: Array) -> Array:
    """What would be measured (..., 5) of states (..., 5): as in `Looked`."""
    centre = middle(way, states)
    return np.concatenate(
        [
            projected(rig.left.K, centre),
            patches.log_height(projected(rig.left.K, shape.points(way, states)))[..., None],
            projected(rig.right.K, in_right(rig, centre)),
        ],
        axis=-1,
    )


def shape_of(rig: StereoRig, way: Way, quad: Array, depth: float, facing: float) -> tuple[Shape, Array]:
    """The front in a left quad (4, 2) px whose middle is `depth` (m) away, and its state (5,).

    It faces along the way; where the way's cosine to the line of sight is below `facing`, it faces the camera.
    """
    ray = np.append(quad.mean(axis=0), 1.0) @ np.linalg.inv(rig.left.K).T
    place = ray * depth
    s = way.nearest(place)
    point, axes = way.frame(np.array(s))
    along = axes[:, 0] @ ray / np.linalg.norm(ray)
    normal = axes[:, 0] if abs(along) > facing else np.array([0.0, 0.0, 1.0])
    corners = on_plane(rig.left.K, quad, normal, np.asarray(normal @ place))
    # The middle of the corners in space is what is tracked.
    place = corners.mean(axis=0)
    off = place - point
    state = np.array([s + off @ axes[:, 0], 0.0, off @ axes[:, 1], off @ axes[:, 2], 0.0])
    return Shape((corners - place) @ axes), state


@dataclass(frozen=True, slots=True)
class Looked:
    """One frame's measurement (5,): middle in the left view, log height there, middle in the right; noise (5, 5)."""

    frame: int
    t: float
    z: Array
    R: Array
    quads: dict[str, Array]
    correlation: float
    seen: Seen


@dataclass(slots=True)
class Target:
    """A front that is followed."""

    id: int
    rig: StereoRig
    way: Way
    shape: Shape
    config: StereoConfig
    rng: np.random.Generator
    states: Array  # (P, 5)
    log_weights: Array
    sought: Template
    first: Array  # cell values of the first sight
    reference: Array
    t: float
    given: bool  # named by init.yaml
    on_path: bool
    free_drift: float  # m a frame at 5 frames/s: drift where there is no path
    oriented: bool = False
    last_seen: float = 0.0
    pieces: Pieces = field(default_factory=Pieces)
    looks: list[Looked] = field(default_factory=list)
    causal: list[tuple[int, float, Gaussian, bool]] = field(default_factory=list)
    ended_by: str = ""

    @property
    def mean(self) -> Array:
        """The expected state (5,)."""
        return particles.moments(self.states, self.log_weights).mean


def start(
    identity: int,
    rig: StereoRig,
    way: Way,
    config: StereoConfig,
    views: dict[str, list[Grey]],
    quads: tuple[Array, Array],
    speed: float | None,
    at: tuple[int, float],
    seed: int,
    given: bool,
    on_path: bool,
) -> Target | None:
    """Begin with a front seen in left and right quads (4, 2) px at (frame, t); None where it is behind the cameras."""
    left, right = quads
    place = triangulated(rig, left.mean(axis=0), right.mean(axis=0))
    if not np.isfinite(place).all() or place[2] <= 0.1:
        return None
    shape, state = shape_of(rig, way, left, float(place[2]), FACING if given else FACING_FOUND)
    rng = np.random.default_rng((seed, identity))
    count = config.filter.particles
    states = np.tile(state, (count, 1))
    sigma_depth = place[2] ** 2 / (rig.left.K[0, 0] * rig.baseline) * 0.5
    depth = np.clip(rng.normal(0, sigma_depth / place[2], count), -0.5, 0.5)
    states[:, S] += depth * place[2]
    states[:, SIZE] = depth
    if speed is None:
        states[:, V] = rng.uniform(-1, 1, count) * config.filter.start_speed
    elif not given:
        states[:, V] = speed * (1 + FOUND_SHARE * rng.normal(size=count))
    else:
        sign = np.where(np.arange(count) % 2 == 0, 1.0, -1.0)
        states[:, V] = sign * (speed + rng.normal(0, config.filter.speed_share * abs(speed), count))
    cells = patches.part_values(views["left"], left[None])[0]
    target = Target(
        id=identity,
        rig=rig,
        way=way,
        shape=shape,
        config=config,
        rng=rng,
        states=states,
        log_weights=np.full(count, -np.log(count)),
        sought=patches.template(views["left"], left),
        first=cells,
        reference=cells,
        t=at[1],
        given=given,
        on_path=on_path,
        free_drift=config.filter.free_share * 0.2 * abs(speed or config.filter.start_speed),
        oriented=speed is not None and not given,
        last_seen=at[1],
    )
    # The given right quad says how far away the front is; where it is exactly, the pictures say.
    seen = projected(rig.right.K, in_right(rig, shape.points(way, state)))
    _measure(target, views, at, Alignment(np.zeros(2), np.zeros(2), np.zeros((4, 4)), 1.0), left, seen)
    target.causal.append((*at, particles.moments(states, target.log_weights), bool(target.looks)))
    return target


def predict(target: Target, t: float) -> None:
    """The particles to the time t (s): along the path by their speeds, drifting. Zhu 2012, eqs. 25-27."""
    dt = t - target.t
    if dt <= 0:
        return
    settings, states = target.config.filter, target.states
    root = float(np.sqrt(5 * dt))  # the deviations belong to frames 0.2 s apart
    noise = target.rng.normal(size=(len(states), 3)) * root
    lateral, vertical = drift(target)
    states[:, S] += states[:, V] * dt
    states[:, V] += (settings.sigma_v or 0.15) * noise[:, 0]
    states[:, LATERAL] += lateral * noise[:, 1]
    states[:, VERTICAL] += vertical * noise[:, 2]
    target.t = t


def drift(target: Target) -> tuple[float, float]:
    """Deviations (m a frame at 5 frames/s) across the path and up and down."""
    settings = target.config.filter
    if target.on_path:
        return settings.sigma_lateral, settings.sigma_vertical
    return target.free_drift, target.free_drift / 2


def update(target: Target, views: dict[str, list[Grey]], at: tuple[int, float]) -> None:
    """Weigh the particles by both views, then align the patch from where they agree."""
    quads = _quads(target, target.states)
    values = {view: patches.part_values(views[view], quads[view]) for view in ("left", "right")}
    settings = target.config.observation
    distance = sum(patches.part_distance(values[view], target.reference) for view in values)
    across = patches.correlations(values["left"], values["right"])
    log_likelihood = -settings.lambda_d * distance + settings.lambda_c * across  # Zhu 2012, eqs. 13, 17-18, in logs
    bad = ~np.isfinite(quads["left"]).all(axis=(1, 2)) | ~np.isfinite(quads["right"]).all(axis=(1, 2))
    weights = target.log_weights + np.where(bad, -1e6, log_likelihood)
    target.log_weights = particles.normalised(weights)
    if not target.oriented and len(target.causal) >= SIGN_FRAMES:
        _orient(target)
    seen = _look(target, views, at)
    if seen:
        target.last_seen = at[1]
        _pull(target)
        _take_over(target, views)
        if target.looks[-1].correlation < target.config.observation.fresh:
            target.sought = patches.template(views["left"], target.looks[-1].quads["left"])
    belief = particles.moments(target.states, target.log_weights)
    target.causal.append((*at, belief, seen))
    if particles.effective_number(target.log_weights) < AGAIN * len(target.states):
        _draw(target, target.log_weights)


def _quads(target: Target, states: Array) -> dict[str, Array]:
    corners = target.shape.points(target.way, states)
    return {
        "left": projected(target.rig.left.K, corners),
        "right": projected(target.rig.right.K, in_right(target.rig, corners)),
    }


def _orient(target: Target) -> None:
    """Decide which way the vehicle goes, by what its particles' weights say."""
    ahead = target.states[:, V] >= 0
    share = float(np.exp(target.log_weights[ahead]).sum())
    keep = ahead if share >= 0.5 else ~ahead
    _draw(target, particles.normalised(np.where(keep, target.log_weights, -1e9)))
    target.oriented = True


def _draw(target: Target, log_weights: Array) -> None:
    """Draw the particles anew, a little apart from each other."""
    index = particles.systematic(log_weights, target.rng)
    target.log_weights = np.full(len(index), -np.log(len(index)))
    target.states = particles.regularised(target.states[index], target.log_weights, target.rng, 0.5)


def _look(target: Target, views: dict[str, list[Grey]], at: tuple[int, float]) -> bool:
    """Align the patch in both views, from where the particles and where its own motion put it; whether it was seen."""
    size = views["left"][0].shape[1], views["left"][0].shape[0]
    best: tuple[Alignment, Array] | None = None
    for quad in (left_quad(target), _continued(target, at[1])):
        if quad is None or not patches.inside(quad, size):
            continue
        found = patches.align(views["left"], quad, target.sought, shape=patches.KEPT)
        if found is not None and (best is None or found.correlation > best[0].correlation):
            best = (found, found.quad(quad))
    if best is None or best[0].correlation < target.config.observation.good:
        return False
    return _measure(target, views, at, *best, _right_of(target, best[1]))


def _continued(target: Target, t: float) -> Array | None:
    """The left quad if shift and growth go on as between the last two looks; None where there are fewer."""
    if len(target.looks) < 2:
        return None
    before, last = target.looks[-2:]
    share = (t - last.t) / (last.t - before.t)
    tall = np.exp(last.z[2] + np.clip(share * (last.z[2] - before.z[2]), -0.5, 0.5))
    moved = last.z[:2] + share * (last.z[:2] - before.z[:2])
    usual = left_quad(target) if target.on_path else last.quads["left"]
    return np.asarray(moved + tall / np.exp(patches.log_height(usual)) * (usual - usual.mean(axis=0)))


def _gather(target: Target) -> None:
    """Put particles that have strayed where the patch was found, at the speed between the last two looks."""
    rig, way, look = target.rig, target.way, target.looks[-1]
    points = [triangulated(rig, each.z[:2], each.z[3:]) for each in target.looks[-2:]]
    s = [way.nearest(point) for point in points]
    place, axes = way.frame(np.array(s[-1]))
    off = (points[-1] - place) @ axes
    state = np.array([s[-1], 0.0, off[1], off[2], float(np.mean(target.states[:, SIZE]))])
    state[SIZE] += look.z[2] - expected(rig, way, target.shape, state)[2]
    if len(s) > 1:
        state[V] = (s[-1] - s[0]) / (look.t - target.looks[-2].t)
    sigma = np.array([0.01 * points[-1][2], 0.2 * abs(state[V]), 0.002 * points[-1][2], 0.002 * points[-1][2], 0.01])
    target.states = state + sigma * target.rng.normal(size=target.states.shape)
    target.log_weights = np.full(len(target.states), -np.log(len(target.states)))


def _right_of(target: Target, left: Array) -> Array:
    """Where the right view should show a left quad (4, 2): as much nearer than at the last look as it has grown."""
    rig, last = target.rig, target.looks[-1] if target.looks else None
    depth = target.shape.points(target.way, target.mean)[:, 2]
    if last is not None:
        before = triangulated(rig, last.z[:2], last.z[3:])[2]
        depth = depth / depth.mean() * before * np.exp(last.z[2] - patches.log_height(left))
    rays = np.column_stack([left, np.ones(4)]) @ np.linalg.inv(rig.left.K).T
    return projected(rig.right.K, in_right(rig, rays * depth[:, None]))


def _pull(target: Target) -> None:
    """Weigh the particles by the latest measurement too, tempered: the parts have seen the same pixels already."""
    look = target.looks[-1]
    residual = look.z - expected(target.rig, target.way, target.shape, target.states)
    spread = TEMPER * look.R + np.diag([BLUR_PX**2, BLUR_PX**2, BLUR_STRETCH**2, BLUR_PX**2, BLUR_PX**2])
    distance = np.einsum("pi,ij,pj->p", residual, np.linalg.inv(spread), residual)
    distance = np.where(np.isfinite(distance), distance, 1e6)
    if distance.min() > STRAYED:
        _gather(target)
        return
    target.log_weights = particles.normalised(target.log_weights - 0.5 * distance)


def _measure(
    target: Target,
    views: dict[str, list[Grey]],
    at: tuple[int, float],
    found: Alignment,
    left: Array,
    right: Array,
) -> bool:
    """Align the left view's present patch in the right one, and keep what both say."""
    present = patches.template(views["left"], left)
    size = views["left"][0].shape[1], views["left"][0].shape[0]
    if not patches.inside(right, size):
        return False
    across = patches.align(views["right"], right, present, ACROSS_STRETCH, patches.KEPT)
    if across is None or across.correlation < target.config.observation.good:
        return False
    right = across.quad(right)
    R = np.zeros((5, 5))
    R[:3, :3] = TRUST * found.cov[:3, :3] + np.diag([FLOOR_PX**2, FLOOR_PX**2, FLOOR_STRETCH**2])
    # The right middle was found from the left one: an error of the left is shared, and the search adds its own.
    R[3:, 3:] = R[:2, :2] + TRUST * across.cov[:2, :2] + FLOOR_PX**2 * np.eye(2)
    R[3:, :3], R[:3, 3:] = R[:2, :3], R[:3, :2]
    seen, quads = target.pieces.look(views, {"left": left, "right": right})
    left, right = quads["left"], quads["right"]
    z = np.concatenate([left.mean(axis=0), [patches.log_height(left)], right.mean(axis=0)])
    target.looks.append(Looked(*at, z, R, quads, found.correlation, seen))
    return True


def _take_over(target: Target, views: dict[str, list[Grey]]) -> None:
    """Let the reference follow what is seen, the first one staying in it. Zhu 2012, eq. 14."""
    settings = target.config.observation
    fresh = patches.part_values(views["left"], target.looks[-1].quads["left"][None])[0]
    old, first = settings.epsilon, settings.first_share
    mixed = first * target.first + (1 - first) * (old * target.reference + (1 - old) * fresh)
    mixed = mixed - mixed.mean()
    target.reference = mixed / max(float(mixed.std()), 1e-3)


def left_quad(target: Target) -> Array:
    """Where the front is expected in the left view (4, 2) px."""
    return _quads(target, target.mean)["left"]


def settle_on(target: Target, views: dict[str, list[Grey]], region: Array, dt: float) -> None:
    """Let the patch drift to the middle of the region (4, 2) px that moves, dt (s) after the last time.

    What turns shows new sides: a patch that kept to the old ones would leave the vehicle with them.
    """
    look = target.looks[-1]
    left = look.quads["left"]
    size, asked = np.array(patches.side(left)), np.array(patches.side(region))
    shift = region.mean(axis=0) - left.mean(axis=0)
    if np.any(np.abs(shift) > 0.5 * asked) or np.any(np.abs(np.log(asked / size)) > ALIKE_SIZE):
        return
    share = 1 - np.exp(-dt / SETTLE_S)
    stretch = np.exp(share * float(np.log(asked / size).mean()))
    quads = {}
    for view, quad in look.quads.items():
        middle = quad.mean(axis=0)
        quads[view] = middle + share * shift + stretch * (quad - middle)
    if all(patches.inside(quads[view], (views[view][0].shape[1], views[view][0].shape[0])) for view in quads):
        target.looks[-1] = replace(look, quads=quads)
        target.sought = patches.template(views["left"], quads["left"])
        target.pieces.moved(look.quads, quads)


def leaving(target: Target, size: tuple[int, int]) -> bool:
    """Whether the front has left one of the pictures."""
    quads = _quads(target, target.mean)
    return not all(patches.inside(quads[view], size) for view in quads)
