"""`python -m samples.make free-flow --seed 3 --seconds 15 --out DIR`: a rendered scene with its truth."""

from __future__ import annotations

import argparse
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

from samples.files import write_scene
from samples.road import KINDS


def main() -> None:
    """Write one scene as the command line says."""
    parser = argparse.ArgumentParser(prog="python -m samples.make", description=__doc__)
    parser.add_argument("kind", choices=sorted(KINDS))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=15.0)
    parser.add_argument("--size", default="1280x720", help="width x height, px")
    parser.add_argument("--fps", type=Fraction, default=Fraction(25), help="25, 30, 30000/1001")
    parser.add_argument("--shake", type=float, help="px rms; default: as the kind has it")
    parser.add_argument("--no-shadows", action="store_true")
    parser.add_argument("--noise-px", type=float, default=0.4, help="of the calibration points, px")
    parser.add_argument("--out", type=Path, required=True)
    chosen = parser.parse_args()
    width, height = (int(part) for part in chosen.size.split("x"))
    scene = KINDS[chosen.kind](chosen.seed, chosen.seconds, (width, height), chosen.fps)
    if chosen.shake is not None:
        scene = replace(scene, shake=chosen.shake)
    if chosen.no_shadows:
        scene = replace(scene, light=replace(scene.light, shadow=1.0))
    write_scene(scene, chosen.out, noise_px=chosen.noise_px)


if __name__ == "__main__":
    main()
