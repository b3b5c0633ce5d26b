"""Vehicles inside a region that holds several: boxes tried wherever one could stand, headed the way its corners go."""

from __future__ import annotations

import cv2
import numpy as np

from visfuse_cli.maths import homography
from visfuse_cli.maths.angles import wrap
from visfuse_cli.maths.cameras import ground_scale, project
from visfuse_cli.records import Array, Boxes, GroundCamera
from visfuse_cli.tracking import hypotheses, measure
from visfuse_cli.tracking.evidence import LabelEvidence
from visfuse_cli.tracking.hypotheses import LARGER, SHADOW_ONLY, UNMOVED, Guess
from visfuse_cli.tracking.settings import TrackerSettings
from visfuse_cli.vision import wireframe
from visfuse_cli.vision.points import Courses

SAME_COURSE = 0.4  # rad
LEAST_POINTS, AGREE = 2, 0.6  # corners in a box that tell its course, and the share of them that must
STEP_M = (1.2, 0.6)  # along and across
MOST_PLACES = 1500
LATTICE = 16  # places across and down a region that tell how far it reaches on the ground
TRIED = 10  # of the boxes that fill best
APART = 0.35  # of its length: closer ones of one class are the same
LEAST_CLEAR, LEAST_OPEN = 0.25, 0.4  # shares of what lies just outside that is empty, and of a box that is in view


def scan(
    camera: GroundCamera,
    settings: TrackerSettings,
    evidence: LabelEvidence,
    box: Array,
    moving_area: float,
    heading: float,
    taken: Boxes,
    convincing: bool = True,
) -> list[Guess]:
    """Vehicles with a heading (rad) whose middle may stand in an image box [x, y, w, h] (4,), of which `moving_area`
    px^2 moves."""
    place = _places(camera, settings, box, heading)
    which, pose = _filled(camera, settings, evidence, place, heading, taken)
    if not len(which):
        return []
    car = measure.prior_arrays(settings.target.classes[0])[0]
    whole = np.minimum(hypotheses.area_of(camera, pose, np.tile(car, (len(pose), 1))), moving_area)
    return hypotheses.refined(camera, settings, evidence, which, pose, whole, taken, convincing)


def headings(course: Array) -> list[float]:
    """The courses (rad) that several corners share."""
    found = []
    while len(course) >= LEAST_POINTS:
        like = np.abs(wrap(course[:, None] - course)) < SAME_COURSE
        best = like[np.argmax(like.sum(axis=1))]
        if np.count_nonzero(best) < LEAST_POINTS:
            break
        found.append(float(np.arctan2(np.median(np.sin(course[best])), np.median(np.cos(course[best])))))
        course = course[~best]
    return found


def _places(camera: GroundCamera, settings: TrackerSettings, box: Array, heading: float) -> Array:
    """Where (n, 2) m on the ground the middle of a vehicle may be."""
    u, v = (box[k] + box[k + 2] * np.linspace(0, 1, LATTICE) for k in (0, 1))
    lattice = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    lattice = lattice[ground_scale(camera, lattice) < settings.life.birth_scale]
    if not len(lattice):
        return np.zeros((0, 2))
    c, s = np.cos(heading), np.sin(heading)
    turn = np.array([[c, -s], [s, c]])
    reach = homography.apply(camera.ground.ground_from_image, lattice) @ turn
    low, high = reach.min(axis=0), reach.max(axis=0)
    step = np.array(STEP_M)
    step = step * max(1.0, np.sqrt(np.prod((high - low) / step + 1) / MOST_PLACES))
    along, across = (np.arange(low[k], high[k] + step[k], step[k]) for k in (0, 1))
    place = np.stack(np.meshgrid(along, across), axis=-1).reshape(-1, 2) @ turn.T
    pixels, _ = project(camera, np.column_stack([place, np.zeros(len(place))]))
    inside = np.all((pixels > box[:2]) & (pixels < box[:2] + box[2:]), axis=1)
    return np.asarray(place[inside])


def _filled(
    camera: GroundCamera,
    settings: TrackerSettings,
    evidence: LabelEvidence,
    place: Array,
    heading: float,
    taken: Boxes,
) -> tuple[np.ndarray, Array]:
    """Classes (n,) and poses (n, 3) of the boxes that what moves fills best, with little of it around them."""
    which, pose, score, length = [], [], [], []
    for number, prior in enumerate(settings.target.classes):
        mean, _ = measure.prior_arrays(prior)
        tried = np.column_stack([place, np.full(len(place), heading)])
        fill = evidence.fill(tried, np.tile(mean, (len(tried), 1)), taken)
        per_px = fill.paint - SHADOW_ONLY * (fill.moved - fill.paint) - UNMOVED * (1 - fill.moved)
        value = fill.area**LARGER * fill.open * per_px * fill.clear
        good = (fill.clear > LEAST_CLEAR) & (fill.open > LEAST_OPEN) & (value > 0)
        which.append(np.full(np.count_nonzero(good), number))
        pose.append(tried[good])
        score.append(value[good])
        length.append(np.full(np.count_nonzero(good), mean[0]))
    all_which, all_pose = np.concatenate(which), np.concatenate(pose)
    all_length = np.concatenate(length)
    left = np.concatenate(score)
    chosen: list[int] = []
    while len(chosen) < TRIED and (left > 0).any():
        best = int(np.argmax(left))
        chosen.append(best)
        near = np.linalg.norm(all_pose[:, :2] - all_pose[best, :2], axis=1) < APART * all_length[best]
        left[near & (all_which == all_which[best])] = 0
    return all_which[chosen], all_pose[chosen]


def velocity_of(camera: GroundCamera, guess: Guess, courses: Courses) -> Array | None:
    """How fast (2,) m/s a box goes along its heading by the corners in it; None where they go elsewhere."""
    hull = wireframe.silhouette(camera, guess.pose, guess.size).astype(np.float32)
    if not len(hull):
        return None
    inside = [cv2.pointPolygonTest(hull, (float(u), float(v)), False) >= 0 for u, v in courses.place]
    mine = courses[np.array(inside, dtype=bool)]
    if len(mine.course) < LEAST_POINTS:
        return None
    if np.mean(np.abs(wrap(mine.course - guess.pose[2])) < SAME_COURSE) < AGREE:
        return None
    along = np.array([np.cos(guess.pose[2]), np.sin(guess.pose[2])])
    # what is seen half-way up lies further away on the ground than it is, and goes as much faster
    nearer = max(0.2, 1 - guess.size[2] / 2 / camera.centre[2])
    return np.asarray(along * float(np.median(mine.velocity @ along)) * nearer)
