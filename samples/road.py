"""Scenes from a seed: free flow, queues at a red light, a junction; and points to calibrate from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np

from samples.drives import cruise, queue
from samples.fleet import clear_of, random_vehicle
from samples.junction import crossing_traffic
from samples.scene import (
    NEAREST_DEPTH,
    Array,
    Camera,
    Light,
    Placement,
    Road,
    Scene,
    Trajectory,
    Vehicle,
    share_inside,
)

SCENE_STREAM, POINT_STREAM = 0, 4
FAR_END, NEAR_END = 170.0, -25.0
KMH = 1 / 3.6
QUEUE = 5  # vehicles a lane


@dataclass(frozen=True, slots=True)
class View:
    """Where a camera may be: height (m), how far ahead the picture's upper edge meets the ground (m), how far aside of
    the road's course it may stand (degrees)."""

    up_m: tuple[float, float]
    reach_m: tuple[float, float]
    slant_deg: float


ASIDE = View((6, 9), (80, 100), 60.0)
HIGH = View((9, 13), (60, 80), 20.0)


def free_flow(
    seed: int,
    seconds: float,
    size: tuple[int, int] = (1280, 720),
    fps: Fraction = Fraction(25),
    *,
    every_s: float = 3.5,
) -> Scene:
    """Two directions at 30-90 km/h on 2-4 lanes, a vehicle each `every_s` seconds and lane or so."""
    rng = np.random.default_rng((seed, SCENE_STREAM))
    road = _random_road(rng)
    camera, placement = _random_view(rng, road, size)
    vehicles: list[Vehicle] = []
    for x, direction in road.lanes:
        vehicles += _flowing(rng, x, direction, seconds, every_s, len(vehicles))
    light = _sun(rng, (30, 60))
    return _placed(Scene(camera, placement, road, tuple(vehicles), light, fps, round(seconds * fps), seed))


def dense(seed: int, seconds: float, size: tuple[int, int] = (1280, 720), fps: Fraction = Fraction(25)) -> Scene:
    """A red light seen from a pole 9-13 m high: see `_queues`."""
    return _queues(seed, seconds, size, fps, HIGH, (12, 18))


def dense_low(seed: int, seconds: float, size: tuple[int, int] = (1280, 720), fps: Fraction = Fraction(25)) -> Scene:
    """A red light seen from so low that the first rows hide most of the others: see `_queues`."""
    return _queues(seed, seconds, size, fps, View((6, 9), (80, 100), 25.0), (16, 22))


def _queues(
    seed: int, seconds: float, size: tuple[int, int], fps: Fraction, view: View, sun: tuple[float, float]
) -> Scene:
    """Queues on every lane, trucks that hide cars, shadows longer than cars and a camera that shakes by 2 px."""
    rng = np.random.default_rng((seed, SCENE_STREAM))
    road = replace(_random_road(rng), stop_lines=((48.0, 1), (16.0, -1)))
    camera, placement = _random_view(rng, road, size, view)
    red = (0.1 * seconds, 0.6 * seconds)
    vehicles: list[Vehicle] = []
    for x, direction in road.lanes:
        last = len(vehicles)
        fleet = [random_vehicle(rng, last + i + 1, trucks=0.2) for i in range(QUEUE)]
        stop = next(y * way for y, way in road.stop_lines if way == direction) - 1.0
        gaps = rng.uniform(8, 25, QUEUE) + np.array([vehicle.length for vehicle in fleet])
        starts = stop - rng.uniform(5, 30) - np.cumsum(gaps)
        speeds = rng.uniform(9, 13) * np.ones(QUEUE)
        drives = queue(x, direction, list(starts), [v.length for v in fleet], list(speeds), stop, red, seconds)
        vehicles += [replace(vehicle, trajectory=drive) for vehicle, drive in zip(fleet, drives, strict=True)]
    n_frames = round(seconds * fps)
    return _placed(Scene(camera, placement, road, tuple(vehicles), _sun(rng, sun), fps, n_frames, seed, shake=2.0))


def junction(seed: int, seconds: float, size: tuple[int, int] = (1280, 720), fps: Fraction = Fraction(25)) -> Scene:
    """A crossroads: vehicles that turn left and right, stop, wait, reverse."""
    rng = np.random.default_rng((seed, SCENE_STREAM))
    middle = float(rng.uniform(26, 30))
    road = Road(((-1.75, -1), (1.75, 1)), 3.5, crossing=(middle - 3.5, middle + 3.5))
    camera, placement = _random_view(rng, road, size)
    vehicles = crossing_traffic(rng, middle, seconds)
    n_frames = round(seconds * fps)
    return _placed(Scene(camera, placement, road, vehicles, _sun(rng, (30, 60)), fps, n_frames, seed))


KINDS: dict[str, Callable[..., Scene]] = {
    "free-flow": free_flow,
    "dense": dense,
    "dense-low": dense_low,
    "junction": junction,
}


def calibration_points(
    scene: Scene, n: int = 10, noise_px: float = 0.4, near: float = 15, far: float = 50
) -> list[tuple[float, float, float, float]]:
    """n rows u, v (px, with noise), X, Y (world m), spread over the road between `near` and `far` m from the camera.

    Raises ValueError when the camera does not see that stretch.
    """
    rng = np.random.default_rng((scene.seed, POINT_STREAM))
    left, right = scene.road.edges
    inset = 0.04 * (right - left)
    on_road = np.column_stack([rng.uniform(left + inset, right - inset, 20000), rng.uniform(-60, 60, 20000)])
    camera, ground = scene.camera, scene.placement.points(on_road + [0, _along(scene)])
    distance = np.linalg.norm(ground - camera.centre[:2], axis=1)
    raised = np.column_stack([ground, np.zeros(len(ground))])
    ahead = (distance > near) & (distance < far) & (camera.depth(raised) > NEAREST_DEPTH)
    ground, pixels = ground[ahead], camera.project(raised[ahead])
    seen = np.all((pixels >= 8) & (pixels < np.array(camera.size) - 8), axis=1)
    ground, pixels = ground[seen], pixels[seen]
    if len(ground) < 10 * n:
        raise ValueError(f"the camera hardly sees the road between {near:.0f} and {far:.0f} m")
    # each next point is the one furthest in the picture from those before it, as a surveyor spreads them
    chosen = [int(np.argmax(pixels[:, 1]))]
    gap = np.full(len(pixels), np.inf)
    while len(chosen) < n:
        gap = np.minimum(gap, np.linalg.norm(pixels - pixels[chosen[-1]], axis=1))
        chosen.append(int(np.argmax(gap)))
    noisy = pixels[chosen] + rng.normal(0, noise_px, (n, 2))
    return [(float(u), float(v), float(x), float(y)) for (u, v), (x, y) in zip(noisy, ground[chosen], strict=True)]


def _along(scene: Scene) -> float:
    """Where along the road the camera stands, m."""
    return float(((scene.camera.centre[:2] - scene.placement.offset) @ scene.placement.rotation)[1])


def _random_road(rng: np.random.Generator) -> Road:
    width = float(rng.uniform(3.3, 3.7))
    away, towards = [(1, 1), (2, 1), (1, 2), (2, 2)][rng.integers(4)]
    lanes = [(width * (i + 0.5), 1) for i in range(away)] + [(-width * (i + 0.5), -1) for i in range(towards)]
    return Road(tuple(lanes), width)


def _random_view(
    rng: np.random.Generator, road: Road, size: tuple[int, int], view: View = ASIDE
) -> tuple[Camera, Placement]:
    """A camera 26 m from the middle of the road at y = 26, somewhere in what `view` allows."""
    width, height = size
    focal = float(rng.uniform(900, 1400)) * width / 1280
    up = float(rng.uniform(*view.up_m))
    angle = np.radians(rng.uniform(-view.slant_deg, view.slant_deg))
    foot = np.array([sum(road.edges) / 2, 26.0]) - 26.0 * np.array([np.sin(angle), np.cos(angle)])
    yaw = angle + np.radians(rng.uniform(-2, 2))
    pitch = np.arctan2(height / 2, focal) + np.arctan2(up, rng.uniform(*view.reach_m))
    roll = np.radians(rng.uniform(-1, 1))
    ahead = np.array([np.sin(yaw) * np.cos(pitch), np.cos(yaw) * np.cos(pitch), -np.sin(pitch)])
    level = np.array([np.cos(yaw), -np.sin(yaw), 0.0])
    down = np.cross(ahead, level)
    c, s = np.cos(roll), np.sin(roll)
    camera_from_road = np.stack([c * level + s * down, c * down - s * level, ahead])
    placement = Placement(float(rng.uniform(-np.pi, np.pi)), rng.uniform(-60, 60, 2))
    road_from_world = np.eye(3)
    road_from_world[:2, :2] = placement.rotation.T
    K = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1.0]])
    centre = np.append(placement.points(foot[None])[0], up)
    return Camera(K, camera_from_road @ road_from_world, centre, size), placement


def _sun(rng: np.random.Generator, elevation: tuple[float, float]) -> Light:
    height, course = np.radians(rng.uniform(*elevation)), rng.uniform(-np.pi, np.pi)
    return Light(np.array([np.cos(course) * np.cos(height), np.sin(course) * np.cos(height), np.sin(height)]))


def _flowing(
    rng: np.random.Generator, x: float, direction: int, seconds: float, every_s: float, last: int
) -> list[Vehicle]:
    """One lane's vehicles, each entering late enough never to come near the one before."""
    begin, end = (NEAR_END, FAR_END) if direction > 0 else (-FAR_END, -NEAR_END)
    pace = rng.uniform(35, 85) * KMH
    enters = -float(rng.uniform(0.3, 1.0)) * (end - begin) / pace
    vehicles: list[Vehicle] = []
    while enters < seconds:
        speed = float(np.clip(pace * rng.uniform(0.85, 1.15), 32 * KMH, 84 * KMH))
        sway = (float(rng.uniform(0, 0.06)) * speed, float(rng.uniform(0.3, 0.7)), float(rng.uniform(0, 2 * np.pi)))
        vehicle = random_vehicle(rng, last + len(vehicles) + 1)
        aside = x + float(rng.uniform(-0.25, 0.25))
        while enters < seconds:
            drive: Trajectory = cruise(aside, direction, begin - speed * enters, speed, sway)
            entered = replace(vehicle, trajectory=drive)
            if clear_of(entered, vehicles[-1:], np.arange(-20.0, seconds + 0.1, 0.2), 5.0):
                vehicles.append(entered)
                break
            enters += 0.4
        enters += float(rng.uniform(0.6, 1.6)) * every_s
    return vehicles


def _placed(scene: Scene) -> Scene:
    """The scene with its drives in the world, and of its vehicles those that are seen, numbered as they appear."""
    seen: list[tuple[int, Vehicle]] = []
    for vehicle in scene.vehicles:
        entered = replace(vehicle, trajectory=scene.placement.trajectory(vehicle.trajectory))
        states: Array = entered.trajectory(scene.times)
        shares = np.array([share_inside(scene.camera, entered.corners(state)) for state in states])
        if (shares > 0).any():
            seen.append((int(np.argmax(shares > 0)), entered))
    seen.sort(key=lambda item: (item[0], item[1].id))
    return replace(scene, vehicles=tuple(replace(v, id=i) for i, (_, v) in enumerate(seen, start=1)))
