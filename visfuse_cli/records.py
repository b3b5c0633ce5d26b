"""Every type that crosses a module border: frozen, no logic; arrays are float64 unless said otherwise."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Boxes = tuple[Array, Array]  # on the ground: poses (N, 3) x, y m and heading rad, and sizes (N, 3) m


@dataclass(frozen=True, slots=True)
class Frame:
    """One decoded picture: `index` is the 0-based decode index, `t` (s) its presentation time less the first stamp.

    Where the camera was away from its rest and the picture was laid back, `image_from_rest` (3, 3) px leads from the
    picture as it is here to the one that was recorded.
    """

    camera: str
    index: int
    t: float
    image: Image  # (H, W, 3) BGR
    image_from_rest: Array | None = None


@dataclass(frozen=True, slots=True)
class FrameSet:
    """The frames of several views that belong to one instant; a view without a frame is in `missing`.

    `index` is that of the leading view's frame, or goes on counting once that has ended; -1 in its gaps.
    """

    t: float
    frames: dict[str, Frame]
    missing: tuple[str, ...]
    index: int = -1


@dataclass(frozen=True, slots=True)
class TimeAudit:
    """What the time stamps of one clip say about its recording."""

    frames: int
    duration_s: float
    nominal_interval_s: float
    dropped: int  # frames missing in gaps of the stamps
    irregular: int  # intervals off the nominal one by more than a fifth
    duplicated: int  # equal stamps, or pictures identical in every pixel
    lost: int  # frames announced by the container that could not be decoded
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Gaussian:
    """A belief: mean (..., n), cov (..., n, n)."""

    mean: Array
    cov: Array


class Innovation(NamedTuple):
    """What a measurement said about a prediction: residual (..., m), cov (..., m, m), nis and log-likelihood (...)."""

    residual: Array
    cov: Array
    nis: Array
    log_likelihood: Array


@dataclass(frozen=True, slots=True)
class Lens:
    """Pinhole and distortion of one camera: K (3, 3) px, D (k,) in OpenCV's order; footage is undistorted to K."""

    K: Array
    D: Array


@dataclass(frozen=True, slots=True)
class StereoRig:
    """Two cameras that do not move against each other: x_right = R x_left + T, R (3, 3), T (3,) m."""

    left: Lens
    right: Lens
    R: Array
    T: Array
    image_size: tuple[int, int] | None  # (w, h) px, where the calibration names it

    @property
    def baseline(self) -> float:
        """Distance of the two optical centres, m."""
        return float(np.linalg.norm(self.T))


@dataclass(frozen=True, slots=True)
class GivenTarget:
    """A target named by hand: frame, left quad (4, 2) px clockwise from the top left, right quad or None, speed m/s."""

    frame: int
    left: Array
    right: Array | None
    speed: float | None


@dataclass(frozen=True, slots=True)
class View:
    """One of several fixed cameras: x_camera = R x_world + t, R (3, 3), t (3,) m; size (w, h) px of its footage."""

    name: str
    lens: Lens
    size: tuple[int, int]
    R: Array
    t: Array

    @property
    def centre(self) -> Array:
        """The optical centre (3,) in the world, m."""
        return np.asarray(-self.R.T @ self.t)


@dataclass(frozen=True, slots=True)
class Sighting:
    """One person in one camera at one instant: the tracked point z (2,) px without distortion, its noise R (2, 2).

    box (4,) px as the picture shows it; `dt` (s) from the instant of the set to the camera's own. `lever` (3,) says how
    many m z moves up the body for each m that is added to height, head and feet, and `assumed` (m) what of it is in z.
    """

    z: Array
    R: Array
    box: Array
    dt: float = 0.0
    lever: Array = field(default_factory=lambda: np.zeros(3))
    assumed: float = 0.0


@dataclass(frozen=True, slots=True)
class GroundReference:
    """Where a ground plane lies on earth: easting = X + origin[0], northing = Y + origin[1], metres of an EPSG code."""

    code: str
    origin: tuple[float, float]


@dataclass(frozen=True, slots=True)
class GroundMap:
    """Image (or gaze frontal plane) to ground metres: a homography with the covariance of its entries.

    ground_from_image (3, 3) at its stated scale, cov (9, 9) of its entries row by row (rank 8); `ground_sign` is
    the sign of the third homogeneous coordinate on the visible side of the horizon.
    """

    ground_from_image: Array
    cov: Array
    ground_sign: int
    input: str  # "pixel" or "gaze"
    image_size: tuple[int, int] | None
    lens: Lens | None
    rms_m: float
    rms_px: float
    residuals: tuple[dict[str, Any], ...] = ()
    source: str = ""
    reference: GroundReference | None = None


@dataclass(frozen=True, slots=True)
class Region:
    """One connected moving region: box (4,) px, hull (k, 2) px of its outline, which hull points lie on the border.

    `around` (4,) px is the box of all that moves in one piece with it: shadow, and paint that was taken for road or
    shadow; `around_area` px^2 is how much that is.
    """

    box: Array
    hull: Array
    at_border: NDArray[np.bool_]  # (k,): the frame's edge was seen there and not the thing's own
    area: float
    around: Array
    around_area: float
    score: float = 1.0
    upright: bool = False  # a detector's box: only its four sides are the thing's own


@dataclass(frozen=True, slots=True)
class RunRequest:
    """What the command line asks of one tracking command."""

    command: str
    input: Path
    out: Path
    config: Any  # the command's own frozen model
    options: dict[str, Any] = field(default_factory=dict)
    overwrite: bool = False
    video: bool = True
    report: bool = True
    start: float | None = None
    end: float | None = None
    seed: int = 0
    progress: bool = True
    argv: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class RunResult:
    """What a command leaves behind: the output folder, its summary, warnings, and the signal that cut it short."""

    out: Path
    summary: dict[str, Any]
    warnings: tuple[str, ...] = ()
    stopped_by: int | None = None  # signal number
    stages: dict[str, float] = field(default_factory=dict)  # s spent in each


@dataclass(frozen=True, slots=True)
class GroundCamera:
    """A camera over the ground plane: P (3, 4) world metres (z up from the plane) -> undistorted pixels.

    The columns for X, Y and 1 reproduce the ground map exactly; `centre` (3,) m, `focal` px.
    """

    image_from_world: Array
    ground: GroundMap
    centre: Array
    focal: float
    image_size: tuple[int, int]
