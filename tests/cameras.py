"""Cameras over a plane, for tests: exact maps from the ground to pixels."""

import numpy as np


def image_from_ground(
    pitch: float = 0.35,
    yaw: float = 0.1,
    height: float = 7.0,
    focal: float = 1000.0,
    principal: tuple[float, float] = (639.5, 359.5),
) -> np.ndarray:
    """Ground (x right, y ahead, m) to pixels (3, 3), of a camera `height` m above the origin, pitched down (rad)."""
    K = np.array([[focal, 0, principal[0]], [0, focal, principal[1]], [0, 0, 1]])
    ahead = np.array([-np.sin(yaw) * np.cos(pitch), np.cos(yaw) * np.cos(pitch), -np.sin(pitch)])
    right = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    R = np.stack([right, np.cross(ahead, right), ahead])
    return K @ np.column_stack([R[:, 0], R[:, 1], -R @ [0, 0, height]])


def ground_points(rng: np.random.Generator, n: int) -> np.ndarray:
    """n points (n, 2) m over the ground before the camera, on a jittered grid so that they always spread."""
    columns = int(np.ceil(np.sqrt(n)))
    cells = rng.permutation(columns * columns)[:n] if n > 4 else np.array([0, 1, 2, 3])
    grid = np.column_stack([cells % columns, cells // columns]) / (columns - 1)
    return np.array([-6.0, 12.0]) + grid * [12, 30] + rng.uniform(-1, 1, (n, 2))
