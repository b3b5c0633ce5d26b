"""The people that are followed: predict, take in what the cameras saw, begin and end."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from visfuse_cli.fusing.audit import Audit, misfits
from visfuse_cli.fusing.body import usual_body
from visfuse_cli.fusing.estimate import Sights, at_one_time, consistent, fuse, stand
from visfuse_cli.fusing.person import History, Person
from visfuse_cli.fusing.settings import FilterSettings, FuseConfig
from visfuse_cli.maths import fusion_rivals, gaussian
from visfuse_cli.maths.assignment import gate_size
from visfuse_cli.maths.motion import constant_velocity, constant_velocity_noise, held_acceleration
from visfuse_cli.records import Array, Gaussian, Sighting

PRIOR_LOOKS = 12.0  # looks that the usual height and width count for
REFUSED_S = 0.5  # s: a person outside the gate for so long is begun again where it is seen
GATE = 1 - 1e-6  # of an agreed position against the prediction


@dataclass(frozen=True, slots=True)
class Newcomer:
    """Somebody seen by two cameras or more who is not followed yet: where (3,) m, and the sightings by camera."""

    place: Gaussian
    sightings: dict[int, Sighting]
    height: float


def motion(dt: float, sigma_a: Array | float, sigma_z: Array | float) -> tuple[Array, Array]:
    """F (6, 6) and Q (..., 6, 6) over dt s; white acceleration sigma_a (...) along the ground, sigma_z upwards."""
    unit = constant_velocity_noise(dt, 1.0, 3)
    density = np.tile(_densities(sigma_a, sigma_z), 2)
    return constant_velocity(dt, 3), unit * density[..., None]


def held_motion(dt: float, sigma_a: Array | float, settings: FilterSettings) -> tuple[Array, Array]:
    """F (9, 9) and Q (..., 9, 9) over dt s with the acceleration as a state, for sigma_a (...) along the ground."""
    F, unit = held_acceleration(round(dt, 9), settings.hold_s)
    density = _densities(sigma_a, settings.sigma_z)
    Q = np.einsum("ab,...i,ij->...aibj", unit, density, np.eye(3))
    return np.asarray(np.kron(F, np.eye(3))), Q.reshape(*density.shape[:-1], 9, 9)


def at_rest(belief: Gaussian, sigma_a: Array | float, settings: FilterSettings) -> Gaussian:
    """A belief (6,) with the acceleration (..., 9) as it is for sigma_a (...) when nothing is known of it."""
    variance = _densities(sigma_a, settings.sigma_z) / (2 * settings.hold_s)
    cov = np.zeros((*variance.shape[:-1], 9, 9))
    cov[..., :6, :6] = belief.cov
    cov[..., 6:, 6:] = variance[..., None] * np.eye(3)
    mean = np.concatenate([belief.mean, np.zeros(3)])
    return Gaussian(np.broadcast_to(mean, (*variance.shape[:-1], 9)), cov)


def _densities(sigma_a: Array | float, sigma_z: Array | float) -> Array:
    """Of the acceleration along x, y and z (..., 3) m^2 s^-3."""
    level, up = np.broadcast_arrays(np.asarray(sigma_a, dtype=float) ** 2, np.asarray(sigma_z, dtype=float) ** 2)
    return np.stack([level, level, up], axis=-1)


def beginning(place: Gaussian, config: FuseConfig) -> Gaussian:
    """The belief (6,) of somebody who was just seen at a place (3,)."""
    cov = np.zeros((6, 6))
    cov[:3, :3] = place.cov
    speed = config.filter.start_speed
    cov[3:, 3:] = np.diag([speed, speed, 0.1 * speed]) ** 2
    return Gaussian(np.concatenate([place.mean, np.zeros(3)]), cov)


class Tracker:
    """Everybody who is followed before cameras P (C, 3, 4), in the ground's frame."""

    def __init__(self, P: Array, config: FuseConfig) -> None:
        self.P, self.config = P, config
        self.people: list[Person] = []
        self._next_id = 1
        self._dt = 0.0  # s from the instant before the latest
        self.audit = Audit(len(P))
        self.distrusted: list[int] = []  # cameras that do not stand where they are said to, as far as is known now

    @property
    def beliefs(self) -> Gaussian:
        """Beliefs (T, 6) of everybody."""
        if not self.people:
            return Gaussian(np.zeros((0, 6)), np.zeros((0, 6, 6)))
        return Gaussian(
            np.stack([person.belief.mean for person in self.people]),
            np.stack([person.belief.cov for person in self.people]),
        )

    def predict(self, t: float) -> None:
        """Everybody to the time t (s)."""
        if not self.people:
            return
        settings = self.config.filter
        self._dt = t - self.people[0].t
        F, Q = motion(self._dt, settings.sigma_a, settings.sigma_z)
        ahead = gaussian.predict(self.beliefs, F, Q)
        for k, person in enumerate(self.people):
            person.belief, person.t = Gaussian(ahead.mean[k], ahead.cov[k]), t
            if person.bank is not None:
                person.bank = fusion_rivals.predicted(person.bank, F, Q)

    def update(self, frame: int, sightings: list[dict[int, Sighting]]) -> None:
        """Take in what each camera saw of each person (T)."""
        if not self.people:
            return
        prior = self.beliefs
        sights = at_one_time(_flat(sightings), self.P, prior)
        settled = np.array([person.confirmed for person in self.people])
        self.audit.take(sights.of(settled[sights.owner]), self.P, prior)
        good = ~np.isin(sights.camera, self.distrusted)
        good[good] = consistent(sights.of(good), self.P, prior.mean[:, :3], self.config.sight.gate)
        good &= self._expected(sights.of(good), good, prior)
        used = sights.of(good)
        banks = [person.bank for person in self.people]
        after = fuse(self.config.fusion.method, prior, used, self.P, banks)
        for k, person in enumerate(self.people):
            cameras = used.camera[used.owner == k].tolist()
            seen = {camera: sightings[k][camera] for camera in cameras}
            person.bank = banks[k]
            person.belief = Gaussian(after.mean[k], after.cov[k])
            if len(seen) == 1:
                level, sigma = person.body.level(self.config.fusion.point == "centroid")
                person.belief = stand(person.belief, level, sigma, self._dt)
            self._remember(person, frame, seen)

    def _expected(self, used: Sights, good: NDArray[np.bool_], prior: Gaussian) -> NDArray[np.bool_]:
        """Rows (M,) whose person is, by all of them together, where it can be; others are refused for a while."""
        after = fuse("central", prior, used, self.P, [])
        keep = good.copy()
        index = np.flatnonzero(good)
        for k in np.unique(used.owner):
            person = self.people[k]
            moved = after.mean[k, :3] - prior.mean[k, :3]
            gained = prior.cov[k, :3, :3] - after.cov[k, :3, :3]
            distance = float(moved @ np.linalg.pinv(gained, rcond=1e-6, hermitian=True) @ moved)
            if distance <= gate_size(3, GATE):
                person.refused_since = None
                continue
            person.refused += 1
            since = person.refused_since = person.t if person.refused_since is None else person.refused_since
            if person.t - since < REFUSED_S:
                keep[index[used.owner == k]] = False
            else:
                person.belief = Gaussian(prior.mean[k], prior.cov[k] * 9.0)
                prior.cov[k] *= 9.0
        return keep

    def _remember(self, person: Person, frame: int, seen: dict[int, Sighting]) -> None:
        person.last = seen
        if seen:
            person.last_seen, person.missed = person.t, 0
            person.cameras |= set(seen)
        if len(seen) >= 2:
            person.seen_frames += 1
            person.last_pair = person.t
        life = self.config.life
        if person.seen_frames >= life.confirm_frames and person.t - person.first_seen >= life.confirm_s - 1e-9:
            person.confirmed = True
        person.history.add(frame, person.t, person.belief.mean, seen)

    def begin(self, frame: int, t: float, newcomers: list[Newcomer]) -> None:
        """Follow newcomers from now on."""
        settings = self.config.person
        for new in newcomers:
            belief = beginning(new.place, self.config)
            person = Person(
                id=self._next_id,
                belief=belief,
                start=belief,
                body=usual_body(new.height, settings.height_sigma, settings.width, PRIOR_LOOKS),
                history=History(len(self.P)),
                t=t,
                last_seen=t,
                first_seen=t,
                last_pair=t,
            )
            self._next_id += 1
            self._remember(person, frame, new.sightings)
            self.people.append(person)

    def miss(self, clear: NDArray[np.bool_], sightings: list[dict[int, Sighting]]) -> None:
        """Take note of who was not seen, not even doubtfully, though cameras had a clear sight of the place (T, C)."""
        for person, open_sights, seen in zip(self.people, clear, sightings, strict=True):
            if not seen:
                person.history.denied[-1] = int(np.count_nonzero(open_sights))
                person.missed += person.history.denied[-1]

    def watch(self, clear: NDArray[np.bool_]) -> None:
        """Take note of which cameras with a clear sight (T, C) were believed to see whom."""
        settled = [k for k, person in enumerate(self.people) if person.confirmed]
        used = np.zeros_like(clear)
        for k in settled:
            used[k, list(self.people[k].last)] = True
        self.audit.sights(clear[settled], used[settled])
        if self.audit.due():
            self.distrusted = misfits(self.audit.findings(np.ones(len(self.P))))

    def end(self, t: float, in_view: NDArray[np.intp]) -> list[Person]:
        """Let go whom nobody has seen for long, or who left; `in_view` (T,) counts the cameras that hold each."""
        life = self.config.life
        ended = []
        for person, views in zip(list(self.people), in_view, strict=True):
            if not person.confirmed:
                unseen = t - person.last_pair
                gone = "never confirmed" if unseen > max(life.confirm_s, 1e-9) * 1.5 and not person.last else ""
                gone = gone or ("never confirmed" if t - person.first_seen > 4 * life.confirm_s + 1.0 else "")
            elif t - person.last_seen > life.max_coast_s or person.missed >= life.max_missed:
                gone = "lost"
            elif views < 2 and t - person.last_seen > life.max_coast_s / 2:
                gone = "left"
            else:
                gone = ""
            if gone:
                person.ended_by = gone
                self.people.remove(person)
                ended.append(person)
        ended += self._twins(t)
        for person in ended:
            person.history.forget(self.distrusted)
        return ended

    def _twins(self, t: float) -> list[Person]:
        """Of two who stand in one place for long, the one known for less time is none."""
        ended = []
        for a in list(self.people):
            for b in self.people:
                if a is b or (a.first_seen, a.id) <= (b.first_seen, b.id) or a in ended:
                    continue
                apart = np.linalg.norm(a.belief.mean[:2] - b.belief.mean[:2])
                if apart < self.config.life.nearest / 2 and not a.confirmed:
                    a.ended_by = "seen twice"
                    ended.append(a)
        self.people = [person for person in self.people if person not in ended]
        return ended

    def finish(self) -> list[Person]:
        """Everybody who is still followed as the footage ends."""
        people, self.people = self.people, []
        for person in people:
            person.history.forget(self.distrusted)
            person.ended_by = "end of footage"
        return people


def _flat(sightings: list[dict[int, Sighting]]) -> Sights:
    rows = [(k, camera, sight) for k, seen in enumerate(sightings) for camera, sight in sorted(seen.items())]
    return Sights(
        np.array([k for k, _, _ in rows], dtype=np.intp),
        np.array([camera for _, camera, _ in rows], dtype=np.intp),
        np.array([sight.z for _, _, sight in rows], dtype=float).reshape(-1, 2),
        np.array([sight.R for _, _, sight in rows], dtype=float).reshape(-1, 2, 2),
        np.array([sight.dt for _, _, sight in rows], dtype=float),
    )
