"""Jointly estimate camera, body sizes and root paths of all people of a video.

One camera shows the direction of a person and how large the person looks.  The distance depends on the lens, on the
size of the person and, on a floor, on the height of the camera.  One robust least-squares problem estimates all of
them: the pitch, the camera's height, the focal length, the sizes, and the logarithm l(t) of each person's distance over
its initial value.  Its terms are in `terms`:

- image: l(t) = log size + log focal, as the person looks in the image;
- floor: the lowest part of everybody is on the floor, an ankle of standing people; nobody is below it, and people above
  it have little weight; a camera that looks up may be below the floor, as before a stage;
- path: a foot that stands does not move in depth, and paths are smooth;
- contact: two bodies do not pass through each other, and a hand that stays on a bone of the other's image for long
  touches it there.  A carried person is on the other's body all the time, not on the floor: that is tried for each of
  two people whose hands are seen on each other, and accepted if the cost falls enough;
- pairs: the difference in depth of two people follows from pairs of the database that look alike;
- stature, pitch and priors: statures are people's, the lens is a common one, and the pitch is near the one whose poses
  fit the image best.

Errors of poses last, so frames near in time count as one in every term that depends on poses.  The weights of robust
terms follow the residuals in each step of the solver, so who stands is estimated with everything else.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from pasdedeux.arrays import Array, Flags
from pasdedeux.errors import check_positive
from pasdedeux.kinematics.rotations import rotate
from pasdedeux.reconstruction.couples import PairDepth
from pasdedeux.reconstruction.pitch import PitchEstimate
from pasdedeux.reconstruction.rays import camera_turns
from pasdedeux.reconstruction.reconstruct import ReconstructedTrack
from pasdedeux.reconstruction.scene_solver import Solution, solve_scene
from pasdedeux.reconstruction.terms.contact import GapTerm, TouchTerm, touching_hands
from pasdedeux.reconstruction.terms.floor import FloorTerm
from pasdedeux.reconstruction.terms.image import ImageTerm
from pasdedeux.reconstruction.terms.pairs import PairTerm
from pasdedeux.reconstruction.terms.path import PathTerm, StanceTerm
from pasdedeux.reconstruction.terms.pitch import PitchTerm
from pasdedeux.reconstruction.terms.placed import ANKLES, By, SeenPeople, SeenPerson, Unknown, rays_through, up_axis
from pasdedeux.reconstruction.terms.prior import KNOWN_DEVIATION, PriorTerm, stature_term
from pasdedeux.reconstruction.terms.term import SceneTerm

_LENS_DEVIATION = 0.3
"""Standard deviation of the log of the focal length over the assumed one."""
_CAMERA_HEIGHT_M, _HEIGHT_DEVIATION = 1.5, 0.6
"""Usual height of a camera over the floor, and the standard deviation of its log."""
_TILT_DEVIATION = 0.04
"""Standard deviation of the slope of the floor that errors of poses in depth cause."""
_ANKLE_DEVIATION_M = 0.02
"""Standard deviation of the height of a person's ankles over the usual one: shoes and heels."""
_CARRIED_COST, _HELD_SHARE = 14.0, 0.5
"""Decrease of the cost above which a person counts as carried, and share of frames with hands on a body for a try."""
_OTHER_SIDE_COST = 2.0
"""Decrease of the cost above which the floor is on the other side of the camera than the first pitch implies."""
_NUM_SHOWN = 5
"""Number of frames over which the deviation of a place is averaged."""


@dataclass(frozen=True)
class SceneEstimate:
    """Camera, body sizes and root paths of everybody.

    Args:
        pitch_rad: Pitch of the camera.
        pitch_deviation_rad: Its standard deviation, from the curvature at the solution.
        pitch_off_rad: How much farther down the rays to people look than the image shows; for a stated pitch, how much
            farther down the camera looks.
        camera_height_m: Height of the camera over the floor; negative below it, as before a stage.
        lens_factor: Focal length over the assumed one.
        sizes: Size of each person over the initial one (person,).
        factors: Distance of each person's mid-hip from the camera over the initial one, (frame,) each.
        place_deviation_m: Standard deviation of the vector from one mid-hip to the other, given floor, sizes and image,
            by the numbers of two people who share a frame; root mean square over frames.
    """

    pitch_rad: float
    pitch_deviation_rad: float
    pitch_off_rad: float
    camera_height_m: float
    lens_factor: float
    sizes: Array
    factors: tuple[Array, ...]
    place_deviation_m: Mapping[tuple[int, int], float]

    @property
    def height_in_words(self) -> str:
        """Return the height of the camera in words."""
        return f"{abs(self.camera_height_m):.2f} m {'above' if self.camera_height_m > 0 else 'below'} the floor"

    def placed(self, number: int, track: ReconstructedTrack) -> ReconstructedTrack:
        """Return the track of a person at the estimated place and size, on the rays of this lens; the pose is kept."""
        person = SeenPerson(track)
        ray = rays_through(person.plane, self.lens_factor)
        root = (person.distance_m * self.factors[number])[:, None] * ray
        relative = rotate(camera_turns(-ray)[:, None], person.relative_m) * self.sizes[number]
        return replace(
            track,
            positions_m=root[:, None] + relative,
            root_m=root,
            metres_per_pixel=track.metres_per_pixel * self.factors[number] / self.lens_factor,
        )


def estimate_scene(
    tracks: Sequence[ReconstructedTrack],
    pitch: PitchEstimate,
    *,
    pairs: Sequence[PairDepth] = (),
    statures_m: Mapping[int, float] | None = None,
    camera_height_m: float | None = None,
) -> SceneEstimate:
    """Jointly estimate camera, body sizes and root paths.

    Args:
        tracks: People at initial places, at least one; mid-hips before the camera.
        pitch: Estimate of the pitch from the image.
        pairs: Depths between couples by pairs of a database; people are numbered as in `tracks`.
        statures_m: Known statures by person id.
        camera_height_m: Height of the camera over the floor, if known.

    Raises:
        InputError: The height of the camera is not above 0.
    """
    if camera_height_m is not None:
        check_positive(camera_height_m, "the height of the camera")
    known = KnownScene(SeenPeople(tuple(map(SeenPerson, tracks))), pitch, pairs, statures_m or {}, camera_height_m)
    seen, sides = known.seen, known.sides()
    # Hands and bodies cause local minima: from one lens alone, noise of a pixel would decide which one is found.
    solutions = [
        min(
            (solve_scene(known.terms(), seen, start, side=side) for start in known.starts()),
            key=lambda tried: tried.cost,
        )
        for side in sides
    ]
    is_other = solutions[-1].cost + _OTHER_SIDE_COST < solutions[0].cost
    side, solution = (sides[-1], solutions[-1]) if is_other else (sides[0], solutions[0])
    carried, cost, start = None, solution.cost - _CARRIED_COST, next(known.starts())
    for people in known.may_carry():
        tried = solve_scene(known.terms(people), seen, start, side=side)
        if tried.cost < cost:
            carried, cost, solution = people, tried.cost, tried
    scene = solution.scene
    # Terms that may be wrong all the time do not make places more certain.
    certain = [term for term in known.terms(carried) if term.is_certain]
    is_said = len(pairs) > 0 or any(touching.any() for touching in known.hands.values())
    apart = solve_scene(certain, seen, scene.x, side=side) if is_said else solution
    return SceneEstimate(
        pitch_rad=float(scene.x[Unknown.PITCH]),
        pitch_deviation_rad=float(np.sqrt(solution.variance_of(np.eye(len(scene.x))[Unknown.PITCH]))),
        pitch_off_rad=PitchTerm(pitch).off_rad(scene),
        camera_height_m=scene.height_m,
        lens_factor=float(np.exp(scene.x[Unknown.LENS])),
        sizes=scene.sizes,
        factors=tuple(np.exp(scene.x[start:stop]) for start, stop in pairwise(seen.starts)),
        place_deviation_m=dict(_place_deviations(apart)),
    )


@dataclass(frozen=True)
class KnownScene:
    """Input of the estimate.

    Args:
        seen: The people.
        pitch: Estimate of the pitch from the image.
        pairs: Depths between couples by pairs of a database.
        statures_m: Known statures by person id.
        camera_height_m: Height of the camera over the floor, if known.
    """

    seen: SeenPeople
    pitch: PitchEstimate
    pairs: Sequence[PairDepth]
    statures_m: Mapping[int, float]
    camera_height_m: float | None

    @cached_property
    def hands(self) -> dict[tuple[int, int], Flags]:
        """For each couple, the bones of the other on which each hand may be, see `touching_hands`."""
        return {couple.people: touching_hands(self.seen, couple) for couple in self.seen.couples}

    def terms(self, carried: tuple[int, int] | None = None) -> list[SceneTerm]:
        """Return the terms of the estimate; `carried` are the numbers of a carried person and the carrier."""
        height_deviation = _HEIGHT_DEVIATION if self.camera_height_m is None else KNOWN_DEVIATION
        terms: list[SceneTerm] = [
            PitchTerm(self.pitch),
            PriorTerm(Unknown.HEIGHT, self._log_height, height_deviation),
            PriorTerm(Unknown.LENS, 0.0, KNOWN_DEVIATION if self.is_lens_known else _LENS_DEVIATION),
            PriorTerm(Unknown.TILT, 0.0, _TILT_DEVIATION),
            stature_term(self.seen, self.statures_m),
            PriorTerm(self.seen.ankles, 0.0, _ANKLE_DEVIATION_M),
        ]
        for number, person in enumerate(self.seen.people):
            terms += [ImageTerm(number), FloorTerm(number, is_carried=carried is not None and carried[0] == number)]
            if len(person.distance_m) > 2:
                terms += [PathTerm(number), StanceTerm(number)]
        terms += [PairTerm(pair) for pair in self.pairs]
        for couple in self.seen.couples:
            is_carrying = carried is not None and set(carried) == set(couple.people)
            terms += [GapTerm(couple, is_carrying=is_carrying), TouchTerm(couple, self.hands[couple.people])]
        return terms

    @property
    def is_lens_known(self) -> bool:
        """Whether the focal length is stated for everybody."""
        return all(person.track.track.lens.is_known for person in self.seen.people)

    def starts(self) -> Iterator[Array]:
        """Yield initial values of the unknowns: people of known stature at that size, the others unchanged.

        The lens is the assumed one; if it is unknown, also one deviation shorter and longer.
        """
        start = np.zeros(self.seen.starts[-1])
        start[Unknown.PITCH], start[Unknown.HEIGHT] = self.pitch.pitch_rad, self._log_height
        for number, person in enumerate(self.seen.people):
            if stature_m := self.statures_m.get(person.track.person_id):
                grown = [self.seen.sizes[number], *self.seen.distances(number)]
                start[grown] = np.log(stature_m / person.stature_m)
        for away in (0.0,) if self.is_lens_known else (0.0, -_LENS_DEVIATION, _LENS_DEVIATION):
            start[Unknown.LENS] = away
            yield start.copy()

    def sides(self) -> list[float]:
        """Return the possible sides of the floor: where the pitch puts the feet, then pitches one deviation off.

        A camera of known height is above the floor.
        """
        if self.camera_height_m is not None:
            return [1.0]
        feet = np.concatenate([person.track.positions_m[:, ANKLES] for person in self.seen.people])
        pitches = self.pitch.pitch_rad + self.pitch.deviation_rad * np.array([0.0, -1.0, 1.0])
        is_above = [np.median((feet @ up_axis(pitch_rad)).min(axis=1)) > 0 for pitch_rad in pitches]
        return list(dict.fromkeys(-1.0 if above else 1.0 for above in is_above))

    def may_carry(self) -> Iterator[tuple[int, int]]:
        """Yield possible pairs of carried person and carrier: hands are on the other's body half of the time."""
        for people, touching in self.hands.items():
            if touching.any(axis=(1, 2)).mean() > _HELD_SHARE:
                yield from (people, people[::-1])

    @property
    def _log_height(self) -> float:
        return float(np.log(self.camera_height_m or _CAMERA_HEIGHT_M))


def _place_deviations(solution: Solution) -> Iterator[tuple[tuple[int, int], float]]:
    """Yield the standard deviation of the vector between two people's mid-hips, by their numbers.

    It follows from the distances of both alone: with the lens too, the interval score of errors of places is worse.
    """
    scene = solution.scene
    for couple in scene.seen.couples:
        shown = np.unique(np.linspace(0, couple.num_frames - 1, _NUM_SHOWN).astype(int))
        weights = np.zeros((len(shown), 3, len(scene.x)))
        for (number, at), sign in zip(couple.sides, (-1.0, 1.0), strict=True):
            moved = scene.joints[number][By.DISTANCE, at[shown], -1]
            weights[np.arange(len(shown)), :, scene.seen.starts[number] + at[shown]] = sign * moved
        yield couple.people, float(np.sqrt(np.mean([sum(map(solution.variance_of, axes)) for axes in weights])))
