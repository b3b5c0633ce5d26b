"""The posterior Cramer-Rao bound along a path: how well a motion that is known can be estimated at all."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from visfuse_cli.maths import gaussian
from visfuse_cli.records import Gaussian

Matrices = Sequence[np.ndarray]


def bound(P0: np.ndarray, F: Matrices, Q: Matrices, H: Matrices, R: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Least covariances (T, n, n) before and after each of T measurements, the first of a state known to P0 (n, n).

    F[k], Q[k] lead to instant k (the first is not read) and H[k] measures there, all at the true state: the inverse of
    the information that Tichavsky's recursion sums, for motions whose noise does not depend on the state.
    """
    zero = np.zeros(len(P0))
    belief, before, after = Gaussian(zero, P0), [], []
    for k in range(len(H)):
        ahead = gaussian.predict(Gaussian(zero, belief.cov), F[k], Q[k]) if k else belief
        belief, _ = gaussian.update(ahead, np.zeros(len(R)), H[k], R)
        before.append(ahead.cov)
        after.append(belief.cov)
    return np.array(before), np.array(after)
