"""What all looks at somebody err by alike, which no filter averages away: added to the covariance that is stated."""

from __future__ import annotations

import numpy as np

from visfuse_cli.fusing.body import LEVEL_M
from visfuse_cli.fusing.estimate import Sights
from visfuse_cli.records import Array, Gaussian

BODY_SIGMA = 0.0035  # m, times the root of the noise found: what cameras err alike, as by feet that point ahead
UPRIGHT_SIGMA = 0.005  # m: heads are not as round as they are taken to be, nor is the ground as flat
EDGE_PX = 0.2  # px: what half of the height is uncertain by, as silhouettes end between pixels
LONE_PX = 1.5  # px: what one camera's looks at a body's middle err by all the time, as where feet are lost


def stated(
    belief: Gaussian, sights: Sights, J: Array, lever: Array, ends: Array, noise: float, centroid: bool
) -> Gaussian:
    """Beliefs (T, 6) with all that is in doubt of the positions.

    J (M, 2, 3) px/m and levers (M, 3) of the sightings (M); `ends` (3, 3) m^2 the covariance of the body's ends;
    `noise` of measurements as a share of the nominal one; `centroid`: the middle of the height is tracked.
    """
    count = len(belief.mean)
    J_W = np.swapaxes(J, -1, -2) @ np.linalg.inv(sights.R)
    information, by_ends = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3, 3))
    np.add.at(information, sights.owner, J_W @ J)
    np.add.at(by_ends, sights.owner, (J_W @ J[:, :, 2:]) * lever[:, None])
    number = np.bincount(sights.owner, minlength=count)
    alone = number == 1
    information[alone, 2, 2] += LEVEL_M**-2  # one camera alone, and the height as it is known
    by_ends[alone, 2, 0] += 0.5 * centroid * LEVEL_M**-2
    by_look = np.zeros((count, 3, 3))  # across, upwards, and the level of the ground
    np.add.at(by_look[:, :, :2], sights.owner, LONE_PX * J_W)
    by_look[:, 2, 2] = LEVEL_M**-1
    moved = np.asarray(np.linalg.solve(information, np.concatenate([by_ends, by_look], axis=2)), dtype=float)
    by_ends, by_look = moved[..., :3], moved[..., 3:]
    by_ends[number == 0] = by_ends[number > 0].mean(axis=0)
    by_look[~alone] = 0.0
    cov = belief.cov.copy()
    cov[:, :3, :3] += BODY_SIGMA**2 * noise * np.eye(3) + by_ends @ ends @ np.swapaxes(by_ends, -1, -2)
    cov[:, :3, :3] += by_look @ np.swapaxes(by_look, -1, -2)
    cov[:, 2, 2] += UPRIGHT_SIGMA**2 + (EDGE_PX / float(np.median(np.linalg.norm(J[:, :, 2], axis=1)))) ** 2
    return Gaussian(belief.mean, cov)
