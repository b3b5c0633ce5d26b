"""Label pictures of boxes on the ground, drawn exactly: what the background stage would say of them."""

import cv2
import numpy as np

from visfuse_cli.maths.cameras import ground_camera
from visfuse_cli.records import GroundMap
from visfuse_cli.tracking.evidence import LabelEvidence
from visfuse_cli.vision import regions, wireframe
from visfuse_cli.vision.background import FOREGROUND, SHADOW

SIZE = (1280, 720)
CAR = np.array([4.4, 1.8, 1.5])
TRUCK = np.array([9.5, 2.5, 3.3])


def road_camera(pitch=0.28, yaw=0.1, focal=1100.0, centre=(2.0, -3.0, 7.5)):
    K = np.array([[focal, 0, 639.5], [0, focal, 359.5], [0, 0, 1.0]])
    forward = np.array([np.sin(yaw) * np.cos(pitch), np.cos(yaw) * np.cos(pitch), -np.sin(pitch)])
    right = np.array([np.cos(yaw), -np.sin(yaw), 0])
    R = np.stack([right, np.cross(forward, right), forward])
    P = K @ np.column_stack([R, -R @ np.array(centre)])
    H = np.linalg.inv(P[:, [0, 1, 3]])
    H /= H[2, 2]
    sign = int(np.sign(H[2] @ [640, 500, 1]))
    return ground_camera(GroundMap(H, 1e-16 * np.eye(9), sign, "pixel", SIZE, None, 0.0, 0.0), SIZE)


def labels_of(camera, boxes, shadows=()):
    """Foreground where one of `boxes` (pose, size) stands, shadow where a box of `shadows` would."""
    picture = np.zeros((SIZE[1], SIZE[0]), np.uint8)
    for value, group in ((SHADOW, shadows), (FOREGROUND, boxes)):
        for pose, size in group:
            hull = wireframe.silhouette(camera, np.asarray(pose, dtype=float), np.asarray(size, dtype=float))
            cv2.fillConvexPoly(picture, np.round(hull * 16).astype(np.int32), value, shift=4)
    return picture


def evidence_of(camera, labels):
    return LabelEvidence(labels, camera, regions.bands(camera), 0.3, 0.12, 0.5)


def drive(start, velocity, times):
    """Poses (n, 3) of a box that drives straight on."""
    start, velocity = np.asarray(start, dtype=float), np.asarray(velocity, dtype=float)
    heading = np.arctan2(velocity[1], velocity[0])
    return np.column_stack([start + np.outer(times, velocity), np.full(len(times), heading)])
