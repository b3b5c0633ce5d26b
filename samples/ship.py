"""`python -m samples.ship [DIR]`: make the sample that the package carries for `visfuse demo`, byte for byte."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

from samples.files import write_scene
from samples.road import free_flow
from samples.scene import Scene, Vehicle, share_inside

SAMPLE = Path(__file__).parents[1] / "visfuse_cli" / "apps" / "sample"
SEED = 7
SECONDS, SIZE, EVERY_S = 10.0, (960, 540), 2.2
POINT_NOISE_PX, CRF = 0.3, 19


def shipped_scene(seed: int = SEED) -> Scene:
    """Free flow of which only the vehicles remain that come and go within the clip."""
    scene = free_flow(seed, SECONDS, SIZE, every_s=EVERY_S)
    passing = [vehicle for vehicle in scene.vehicles if _passes(scene, vehicle)]
    return replace(scene, vehicles=tuple(replace(v, id=number) for number, v in enumerate(passing, start=1)))


def ship(out: Path) -> None:
    """Write the sample's files to the folder `out`."""
    write_scene(shipped_scene(), out, noise_px=POINT_NOISE_PX, crf=CRF, n_points=12)


def _passes(scene: Scene, vehicle: Vehicle) -> bool:
    ends = vehicle.trajectory(scene.times[[0, -1]])
    return all(share_inside(scene.camera, vehicle.corners(state)) == 0 for state in ends)


if __name__ == "__main__":
    ship(Path(sys.argv[1]) if len(sys.argv) > 1 else SAMPLE)
