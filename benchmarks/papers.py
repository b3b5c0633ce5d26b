"""The papers' own experiments, simulated: `python benchmarks/papers.py [bradshaw latency jia lou wu] [--runs 100]`.

Each table shows the paper's figure, where it prints one, beside ours, and a bound where there is one. Everything is
drawn from fixed seeds.
"""

from __future__ import annotations

import sys
from pathlib import Path

from scipy.stats import chi2

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks import bradshaw, choice, jia, lou, pursuit
from tests.test_fusion import simulate


def main() -> None:
    tables = {
        "bradshaw": bradshaw.tables,
        "latency": pursuit.prediction_over_latency,
        "jia": jia.people_straight_and_turning,
        "lou": lou.cars,
        "wu": cameras,
    }
    choice.run(__doc__, tables, "--runs", 100)


def cameras(runs: int) -> None:
    """The simulation: four cameras, every way of fusing them."""
    methods = ("central", "closed-loop", "naive", "kim", "covariance-intersection")
    found = simulate(list(methods), runs=runs)
    low, high = chi2.ppf([0.0005, 0.9995], 6 * runs) / runs  # were the steps of a run all alike
    print("Wu 2010: mean squared error as a share of the centralised bound; normalised error squared (6 is right,")
    print(f"its 99.9 % band {low:.2f} to {high:.2f})")
    print(f"{'the paper, closed loop / naive':<32}{4.475 / 4.889:8.3f}")
    for method in methods:
        verdict = "" if low < found[method][1] < high else "   out of band"
        print(f"{method:<32}{found[method][0] / found['central'][0]:8.3f}{found[method][1]:8.2f}{verdict}")


if __name__ == "__main__":
    main()
