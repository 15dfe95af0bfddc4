"""Jointly estimate camera, body sizes and root paths of all people of a video.

One camera sees in which direction a person is and how large the person looks.  How far away that is depends on the
lens, on how large the person really is and, on a floor, on where the camera stands.  All of it is one robust least
squares over the pitch, the camera's height, the focal length, the sizes, and the logarithm l(t) of each person's
distance over its initial value:

- l(t) = log size + log focal, as the person looks in the image;
- the lowest part of everybody is on the floor, an ankle of who stands; nobody is below it, who leaps is let go of; a
  camera that looks up may be below the floor, as before a stage;
- who is carried is not on the floor but on the other's body, all the time: that is tried for each of two people whose
  hands are seen on each other, and believed if it explains much more;
- a foot that stands does not move in depth, and paths are smooth;
- two bodies do not pass through each other, and a hand that for long keeps its place on a bone of the other's image
  touches it there;
- pairs of the database that look like both say how far apart in depth people stand who are seen so;
- sizes are people's, the lens is a common one, and the pitch is near the one whose poses fit the image best.

Pairs and touches are believed, but no place is called well known for their sake: pairs tell of the couples that the
database holds, a hand before the other's image need not be on it, and where they are wrong they are so all the time.

Errors of poses last: frames near each other in time count as one, in every term that poses enter.
Robust terms are weighed anew in each step of the solver: who stands is decided with everything else.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array, Flags, Integers, merge_axes
from pasdedeux.errors import check_positive
from pasdedeux.interaction.surfaces import surface_gaps
from pasdedeux.kinematics.forward import bone_lengths
from pasdedeux.kinematics.rotations import conjugate, rotate
from pasdedeux.plausibility.capsules import body_height_m, capsule_model
from pasdedeux.reconstruction.couples import PairDepth
from pasdedeux.reconstruction.pitch import PitchEstimate
from pasdedeux.reconstruction.rays import camera_turns
from pasdedeux.reconstruction.reconstruct import ReconstructedTrack
from pasdedeux.reconstruction.robust import Term, solve
from pasdedeux.skeletons import OP14

_ANKLES = np.array([leg[2] for leg in OP14.legs])
_ANKLE_HEIGHT = 0.04
"""Height of the ankle over the floor, standing, as a part of the stature (Winter 2009, fig. 4.1: 0.039)."""
_PITCH, _HEIGHT, _LENS, _TILT, _SIZES = 0, 1, 2, 3, 4
_OWN, _SIZE, _FOCAL = 1, 2, 3
"""Where `places` has the derivatives by what."""
_ACROSS = np.array([1.0, 1.0, 0.0])
_PARENTS = np.array(OP14.parents)
_HANDS = [
    place for place, (_, child) in enumerate(OP14.bones) if OP14.joint_names[child] in ("left_wrist", "right_wrist")
]

# Priors of camera, people and image; deviations are standard deviations.
_GIVEN_RAD = 1e-3
"""Deviation of a pitch that was stated."""
_STATURE_M = 1.68
"""People are about so tall: the mean of women (1.61 m) and men (1.75 m; Fryar et al. 2021)."""
_SIZE_DEVIATION = 0.06
"""Deviation of the log of their stature."""
_KNOWN_DEVIATION = 0.01
"""The same of a stature, a height or a lens that is known."""
_LENS_DEVIATION = 0.3
"""Deviation of the log of the focal length from the assumed."""
_CAMERA_HEIGHT_M = 1.5
"""Cameras stand about so high over the floor."""
_HEIGHT_DEVIATION = 0.6
"""Deviation of the log of that."""
_LOOK_DEVIATION = 0.05
"""Deviation of how large a person looks: poses differ."""
_LOOK_S = 1.0
"""Frames nearer in time than this count as one: they err alike."""
_FLOOR_DEVIATION_M = 0.045
"""Deviation of the lowest part from the floor."""
_ANKLE_DEVIATION_M = 0.02
"""The same of a person all the time: shoes and heels."""
_TILT_DEVIATION = 0.04
"""Deviation of the slope that errors of the poses in depth give the floor."""
_FLOOR_S = 0.7
"""As `_LOOK_S`, for errors of the lowest part's height."""
_STANCE_M_S = 0.3
"""Deviation of the depth speed of a foot that stands."""
_STILL_M_S = 0.3
"""Feet slower than this across the image stand."""
_ACCELERATION_M_S2 = 8.0
"""Deviation of the second derivative of a person's distance."""
_PAIR_S = 0.5
"""As `_LOOK_S`, for what pairs say."""
_CARRIED_COST, _HELD_SHARE = 14.0, 0.5
"""Somebody is taken to be carried if that lowers the cost by more; tried of who is held in a larger share of frames."""
_OTHER_SIDE_COST = 2.0
"""The floor is on the other side of the camera than the first pitch says if that lowers the cost by more."""
_TOUCH_DEVIATION_M = 0.08
"""Deviation of the gap of two people who touch."""
_TOUCH_IMAGE_M, _TOUCH_S, _TOUCH_KEEP_M = 0.05, 3.0, 0.1
"""Hands no further from the other's image may touch, if they stay so long and move along the bone by no more."""
_GAP_DEVIATION_M = 0.05
"""Deviation of how far two bodies pass through each other."""
_NUM_SHOWN = 5
"""Frames that the deviation of a place is the mean of."""
_ROBUST = 3.0
"""At so many deviations a residual counts a quarter (Geman, McClure)."""


@dataclass(frozen=True)
class SceneEstimate:
    """Camera, body sizes and root paths of everybody.

    Args:
        pitch_rad: Pitch of the camera.
        pitch_deviation_rad: Standard deviation of it, from the curvature of what was solved.
        pitch_off_rad: By how much the rays to people look farther down than their image says; of a given pitch, the
            camera than was given.
        camera_height_m: Height of the camera over the floor; below 0 under it, as before a stage.
        lens_factor: Focal length over the assumed one.
        sizes: Size of each person over the initial one (person,).
        factors: Distance of each person's mid-hip from the camera over the initial one, (frame,) each.
        place_deviation_m: Standard deviation of the vector from one mid-hip to the other, as floor, sizes and image
            leave it, by the numbers of two people who are in a frame together; root mean square over frames.
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
        """Say how high the camera is."""
        return f"{abs(self.camera_height_m):.2f} m {'above' if self.camera_height_m > 0 else 'below'} the floor"

    def placed(self, number: int, found: ReconstructedTrack) -> ReconstructedTrack:
        """Return the reconstruction of a person at its place and size, on the rays of this lens, pose kept."""
        length = np.linalg.norm(found.root_m, axis=-1)
        ray = _rays(found.root_m[:, :2] / -found.root_m[:, 2:], self.lens_factor)
        root = (length * self.factors[number])[:, None] * ray
        relative = rotate(camera_turns(-ray)[:, None], _relative(found)) * self.sizes[number]
        return replace(
            found,
            positions_m=root[:, None] + relative,
            root_m=root,
            metres_per_pixel=found.metres_per_pixel * self.factors[number] / self.lens_factor,
        )


def _up(pitch_rad: float) -> Array:
    """Return the direction upwards in the axes of a camera of this pitch."""
    return np.array([0.0, np.cos(pitch_rad), np.sin(pitch_rad)])


def _up_further(pitch_rad: float) -> Array:
    """Return the derivative of that by the pitch."""
    return _up(pitch_rad + 0.5 * np.pi)


def _rays(plane: Array, lens_factor: float) -> Array:
    """Return unit directions (n, 3) from the camera through points (n, 2) of an image one focal length away."""
    rays = np.concatenate([plane / lens_factor, -np.ones((len(plane), 1))], axis=1)
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def _relative(found: ReconstructedTrack) -> Array:
    """Return poses (frame, 14, 3) about the mid-hip as a camera turned to it sees them."""
    towards = -found.root_m / np.linalg.norm(found.root_m, axis=-1, keepdims=True)
    return rotate(conjugate(camera_turns(towards))[:, None], found.positions_m - found.root_m[:, None])


def _of_hands(first: Array, second: Array | None = None) -> Array:
    """Return what (frame, bone of A, bone of B) is of A's hands and every bone of B, B's hands and every one of A."""
    second = first if second is None else second
    return np.concatenate([first[:, _HANDS], second[:, :, _HANDS].swapaxes(1, 2)], axis=1)


class _Problem:
    """The residuals of `estimate_scene` as a function of all unknowns."""

    def __init__(
        self,
        people: Sequence[ReconstructedTrack],
        pitch: PitchEstimate,
        pairs: Sequence[PairDepth],
        statures_m: Mapping[int, float],
        camera_height_m: float | None,
    ) -> None:
        self.people, self.pairs, self.pitch = people, pairs, pitch
        # Who is carried, and by whom: `estimate_scene` tries it.
        self.carried: tuple[int, int] | None = None
        is_lens_known = all(one.track.lens.is_known for one in people)
        self.lens_deviation = _KNOWN_DEVIATION if is_lens_known else _LENS_DEVIATION
        self.log_height = float(np.log(camera_height_m or _CAMERA_HEIGHT_M))
        self.height_deviation = _HEIGHT_DEVIATION if camera_height_m is None else _KNOWN_DEVIATION
        counts = [len(one.root_m) for one in people]
        self.num_globals = _SIZES + 2 * len(people)
        self.starts = self.num_globals + np.concatenate([[0], np.cumsum(counts)])
        self.distance = [np.linalg.norm(one.root_m, axis=-1) for one in people]
        self.mean_distance = float(np.mean(np.concatenate(self.distance)))
        self.plane = [one.root_m[:, :2] / -one.root_m[:, 2:] for one in people]
        self.images = [one.positions_m[..., :2] / -one.positions_m[..., 2:] for one in people]
        self.relative = [_relative(one) for one in people]
        lengths = [np.median(bone_lengths(OP14, one.positions_m), axis=0) for one in people]
        self.stature = np.array([float(body_height_m(OP14, one)) for one in lengths])
        stated = [statures_m.get(one.track.person_id) for one in people]
        self.wanted_stature = np.array([one or _STATURE_M for one in stated])
        self.size_deviation = np.array([_SIZE_DEVIATION if one is None else _KNOWN_DEVIATION for one in stated])
        self.radii = capsule_model(OP14).radii_m(self.stature)
        self.bearing = np.array(self.radii)
        self.bearing[:, _ANKLES] = _ANKLE_HEIGHT * self.stature[:, None]
        self.still = [self._still(one) for one in people]
        # The floor is below the camera, or above it (-1.0), as before a stage: `estimate_scene` tries what may be.
        self.side = 1.0
        start = np.zeros(self.starts[-1])
        start[_PITCH], start[_HEIGHT] = pitch.pitch_rad, self.log_height
        for number in (at for at, one in enumerate(stated) if one is not None):
            size = np.log(self.wanted_stature[number] / self.stature[number])
            start[_SIZES + number] = start[self.starts[number] : self.starts[number + 1]] = size
        self.start = start
        self.near = []
        for first, second in combinations(range(len(people)), 2):
            one, other = people[first].track, people[second].track
            frames = np.intersect1d(one.frames, other.frames)
            if len(frames):
                self.near.append((first, second, frames - one.first_frame, frames - other.first_frame))
        self.touching = {(first, second): self._touching(first, second, *at) for first, second, *at in self.near}

    def may_carry(self) -> Iterator[tuple[int, int]]:
        """Yield who may be carried and by whom: of two people hands are seen on a body for half of the time."""
        for both, hands in self.touching.items():
            if hands.any(axis=(1, 2)).mean() > _HELD_SHARE:
                yield from (both, both[::-1])

    def go_on_apart(self, x: Array) -> bool:
        """Go on from here without what pairs and touches say; tell whether they say anything."""
        is_said = bool(self.pairs) or any(hands.any() for hands in self.touching.values())
        self.start, self.pairs = x, ()
        self.touching = {both: np.zeros_like(hands) for both, hands in self.touching.items()}
        return is_said

    def _still(self, one: ReconstructedTrack) -> Array:
        """Return how much each foot stands by the image alone (frame, foot)."""
        ankles = one.positions_m[:, _ANKLES, :2]
        if len(ankles) < 2:
            return np.zeros(ankles.shape[:2])
        speed = np.linalg.norm(np.gradient(ankles, axis=0), axis=-1) * one.track.rate_hz
        return np.where(one.is_bridged[:, None], 0.0, 1.0 / (1.0 + (speed / _STILL_M_S) ** 4))

    def _touching(self, first: int, second: int, one_at: Integers, other_at: Integers) -> Flags:
        """Return on which bones of the other each hand (frame, A's two and B's two, bone) keeps its place in the image.

        A hand that only passes before the other, or dances there, moves along the bone.
        """
        from scipy.ndimage import maximum_filter1d, minimum_filter1d  # here: 0.2 s that planning does not need

        both = np.stack([self.people[n].positions_m[at] for n, at in ((first, one_at), (second, other_at))], axis=1)
        lengths = np.median(np.stack([bone_lengths(OP14, both[:, n]) for n in (0, 1)]), axis=1)
        depth = -both[..., 2].mean(axis=(1, 2))
        flat = both / -both[..., 2:] * depth[:, None, None, None]
        flat[..., 2] = 0.0
        between = surface_gaps(flat, self.radii[[first, second]], OP14)
        gap = _of_hands(between.gap_m)
        along = _of_hands(between.share[..., 1], between.share[..., 0])
        along = along * lengths[[1, 1, 0, 0]][:, between.bones]
        length = 2 * round(0.5 * _TOUCH_S * self.people[first].track.rate_hz) + 1
        high, low = (op(along, length, axis=0) for op in (maximum_filter1d, minimum_filter1d))
        stays = maximum_filter1d(gap, length, axis=0) < _TOUCH_IMAGE_M
        stays &= high - low < _TOUCH_KEEP_M
        return maximum_filter1d(stays.astype(np.uint8), length, axis=0).astype(bool)

    def places(self, x: Array, number: int) -> Array:
        """Return joints and mid-hip (frame, 15, 3) of a person, camera axes, and their derivatives, (4, frame, 15, 3).

        These are by `_OWN`: the unknown of each frame, by `_SIZE`, and by `_FOCAL`, the log of the focal length.
        """
        ray = _rays(self.plane[number], float(np.exp(x[_LENS])))
        own = slice(self.starts[number], self.starts[number + 1])
        root = (self.distance[number] * np.exp(x[own]))[:, None] * ray
        relative = rotate(camera_turns(-ray)[:, None], self.relative[number]) * np.exp(x[_SIZES + number])
        # A longer lens turns rays towards the axis, and people with them.
        aside = (ray[:, :2] ** 2).sum(axis=1)[:, None]
        turned = (relative[..., :2] * ray[:, None, :2]).sum(axis=-1) * ray[:, 2:]
        # Every joint stays on its own ray, whatever the lens.
        depth = root[:, 2:] + relative[..., 2]
        depths = np.stack(np.broadcast_arrays(depth, root[:, 2:], relative[..., 2], root[:, 2:] * aside + turned))
        image = -self.images[number] * np.exp(-x[_LENS])
        joints = depths[..., None] * np.concatenate([image, np.ones((*depth.shape, 1))], axis=-1)
        joints[_FOCAL] -= joints[0] * _ACROSS
        roots = np.stack([root, root, np.zeros(root.shape), root * aside - root * _ACROSS])
        return np.concatenate([joints, roots[:, :, None]], axis=2)

    def terms(self, x: Array) -> list[Term]:
        """Return the residuals at these unknowns."""
        placed = [self.places(x, number) for number in range(len(self.people))]
        terms = [self._priors(x)]
        for number, own in enumerate(placed):
            terms += self._person(x, number, own)
        terms += [self._pair(pair, placed, x) for pair in self.pairs]
        for couple in self.near:
            terms += self._near(couple, placed, x)
        return terms

    def _near(self, couple: tuple[int, int, Integers, Integers], placed: Sequence[Array], x: Array) -> list[Term]:
        """Return what two bodies say that are in a frame together."""
        first, second, one_at, other_at = couple
        own = placed[first][:, one_at], placed[second][:, other_at]
        sizes = _SIZES + first, _SIZES + second
        size = np.exp(x[list(sizes)])
        radii = self.radii[[first, second]] * size[:, None]
        between = surface_gaps(np.stack([one[0, :, :-1] for one in own], axis=1), radii, OP14)
        stencil = _table(self.starts[first] + one_at, self.starts[second] + other_at, *sizes, _LENS)

        def gaps(rows: Integers, bones: Array, deviation_m: float) -> tuple[Array, Array]:
            """Return the gaps of two bones (2, row) in these frames, in deviations, and their slopes."""
            joints, share = between.bones[bones], between.share[rows, bones[0], bones[1]]
            ends = []
            for side in (0, 1):
                start, end = (own[side][:, rows, at] for at in (_PARENTS[joints[side]], joints[side]))
                ends.append(start + share[:, side, None] * (end - start))
            apart = ends[1][0] - ends[0][0]
            unit = size.mean() * deviation_m
            along = apart / np.maximum(unit * np.linalg.norm(apart, axis=1, keepdims=True), 1e-9)
            value = between.gap_m[rows, bones[0], bones[1]] / unit
            one, other = -(ends[0] * along).sum(axis=-1), (ends[1] * along).sum(axis=-1)
            # Bodies grow thicker, and the deviation wider.
            thicker = [radii[side][joints[side]] / unit + 0.5 * value * size[side] / size.mean() for side in (0, 1)]
            grown = one[_SIZE] - thicker[0], other[_SIZE] - thicker[1]
            return value, _table(one[_OWN], other[_OWN], *grown, one[_FOCAL] + other[_FOCAL])

        alike = self._alike(first, _FLOOR_S)
        frames = np.arange(len(one_at))
        nearest = merge_axes(between.gap_m, 1).argmin(axis=1)
        apart, slopes = gaps(frames, np.stack(np.divmod(nearest, len(between.bones))), _GAP_DEVIATION_M)
        if self.carried not in ((first, second), (second, first)):
            apart, slopes = np.minimum(apart, 0.0), slopes * (apart < 0.0)[:, None]
        terms = [Term(apart, stencil, slopes, weight=alike)]
        touching = self.touching[first, second]
        bone = np.where(touching, _of_hands(between.gap_m), np.inf).argmin(axis=2)
        rows, hand = np.nonzero(touching.any(axis=2))
        bones = np.stack([np.array(_HANDS * 2)[hand], bone[rows, hand]])
        bones = np.where(hand < len(_HANDS), bones, bones[::-1])
        touch, slopes = gaps(rows, bones, _TOUCH_DEVIATION_M)
        touch, slopes = np.maximum(touch, 0.0), slopes * (touch > 0.0)[:, None]
        return [*terms, Term(touch, stencil[rows], slopes, is_robust=True, weight=alike)]

    def sides(self) -> list[float]:
        """Return where the floor may be: where feet are by the pitch, then by a pitch that is one deviation off."""
        feet = np.concatenate([one.positions_m[:, _ANKLES] for one in self.people])
        pitches = self.pitch.pitch_rad + self.pitch.deviation_rad * np.array([0.0, -1.0, 1.0])
        is_above = [np.median((feet @ _up(pitch)).min(axis=1)) > 0 for pitch in pitches]
        return list(dict.fromkeys(-1.0 if one else 1.0 for one in is_above))

    def height_m(self, x: Array) -> float:
        """Return the height of the camera over the floor, below 0 of one that is under it."""
        return self.side * float(np.exp(x[_HEIGHT]))

    def places_between(self, x: Array) -> Iterator[tuple[int, int, Array]]:
        """Yield two people's numbers and how the vector between them (some of the frames, 3) depends on unknowns."""
        for first, second, one_at, other_at in self.near:
            shown = np.unique(np.linspace(0, len(one_at) - 1, _NUM_SHOWN).astype(int))
            weights = np.zeros((len(shown), 3, len(x)))
            for number, at, sign in ((first, one_at[shown], -1.0), (second, other_at[shown], 1.0)):
                moved = self.places(x, number)[_OWN, at, -1]
                weights[np.arange(len(shown)), :, self.starts[number] + at] = sign * moved
            yield first, second, weights

    def _alike(self, number: int, seconds: float) -> float:
        """Return what each of the frames counts that err alike for so long."""
        return 1.0 / max(1.0, seconds * self.people[number].track.rate_hz)

    def _person(self, x: Array, number: int, placed: Array) -> list[Term]:
        """Return what image, floor and time say of one person, placed as `places` says."""
        found, rate_hz = self.people[number], self.people[number].track.rate_hz
        at, own_size = np.arange(self.starts[number], self.starts[number + 1]), _SIZES + number
        own_ankle = own_size + len(self.people)
        known = np.flatnonzero(~found.is_bridged)
        looks = (x[at] - x[own_size] - x[_LENS]) / _LOOK_DEVIATION
        stencil = _table(at, own_size, _LENS)[known]
        slopes = np.broadcast_to(np.array([1.0, -1.0, -1.0]) / _LOOK_DEVIATION, stencil.shape)
        terms = [Term(looks[known], stencil, slopes, is_robust=True, weight=self._alike(number, _LOOK_S))]
        size, joints = np.exp(x[own_size]), placed[:, :, :-1]
        # What poses err in depth tilts the floor, which is not the pitch.
        up = np.array([*_up(x[_PITCH])[:2], _up(x[_PITCH])[2] + x[_TILT]])
        bearing = self.bearing[number] * size + x[own_ankle]
        height = self.height_m(x)
        above = joints[0] @ up + height + x[_TILT] * self.mean_distance - bearing
        alike = self._alike(number, _FLOOR_S)
        # Errors of poses grow with people: whoever is small gains nothing by it.
        unit = size * _FLOOR_DEVIATION_M
        lowest, frames = np.argmin(above, axis=1), np.arange(len(at))
        floor, bears = above[frames, lowest] / unit, joints[:, frames, lowest]
        moved = bears[1:] @ up / unit
        slopes = _table(
            moved[0],
            moved[1] - self.bearing[number][lowest] / _FLOOR_DEVIATION_M - floor,
            moved[2],
            bears[0] @ _up_further(x[_PITCH]) / unit,
            height / unit,
            (bears[0, :, 2] + self.mean_distance) / unit,
            -1.0 / unit,
        )
        if self.carried is not None and number == self.carried[0]:
            floor, slopes = np.minimum(floor, 0.0), slopes * (floor < 0.0)[:, None]
        stencil = _table(at, own_size, _LENS, _PITCH, _HEIGHT, _TILT, own_ankle)
        terms.append(Term(floor[known], stencil[known], slopes[known], floor[known] > 0, weight=alike))
        if len(at) > 2:
            distance = self.distance[number] * np.exp(x[at] - x[own_size]) * rate_hz**2 / _ACCELERATION_M_S2
            bend = np.diff(distance, n=2)
            slopes = _table(distance[:-2], -2.0 * distance[1:-1], distance[2:], -bend)
            terms.append(Term(bend, _table(at[:-2], at[1:-1], at[2:], own_size), slopes))
            still = np.sqrt(np.minimum(self.still[number][1:], self.still[number][:-1]))
            lower = np.argmin(above[:, _ANKLES], axis=1)[1:]
            rows = np.arange(len(lower))
            per_m = still[rows, lower] * rate_hz / (size * _STANCE_M_S)
            before, after = (joints[:, own, _ANKLES[lower], 2] * per_m for own in (frames[:-1], frames[1:]))
            step, grown, focal = after[[0, _SIZE, _FOCAL]] - before[[0, _SIZE, _FOCAL]]
            slopes = _table(-before[_OWN], after[_OWN], grown - step, focal)
            terms.append(Term(step, _table(at[:-1], at[1:], own_size, _LENS), slopes, is_robust=True, weight=alike))
        return terms

    def _priors(self, x: Array) -> Term:
        people, unit = len(self.people), self.pitch.deviation_rad or _GIVEN_RAD
        sizes = np.log(self.wanted_stature / self.stature)
        at = np.array([_HEIGHT, _LENS, _TILT, *range(_SIZES, self.num_globals)])
        wanted = np.array([self.log_height, 0.0, 0.0, *sizes, *np.zeros(people)])
        deviation = np.array([self.height_deviation, self.lens_deviation, _TILT_DEVIATION, *self.size_deviation])
        deviation = np.concatenate([deviation, np.full(people, _ANKLE_DEVIATION_M)])
        off, by_pitch, by_lens = self.pitch_off_rad(x) / unit
        return Term(
            np.array([off, *(x[at] - wanted) / deviation]),
            np.array([[_PITCH, *at], [_LENS, *at]]).T,
            np.array([[by_pitch, *1.0 / deviation], [by_lens, *np.zeros(len(at))]]).T,
        )

    def pitch_off_rad(self, x: Array) -> Array:
        """Return how far the pitch is off: that of the rays to people is what suits their image.

        Beside it stand its derivatives by pitch and by the log of the focal length, (3,).
        """
        if self.pitch.is_given:
            return np.array([x[_PITCH] - self.pitch.pitch_rad, 1.0, 0.0])
        known = [plane[~one.is_bridged] for plane, one in zip(self.plane, self.people, strict=True)]
        ray, up = _rays(np.concatenate(known), float(np.exp(x[_LENS]))), _up(x[_PITCH])
        turned = ray * (ray[:, :2] ** 2).sum(axis=1)[:, None] - ray * _ACROSS
        down, *slopes = np.clip(-ray @ up, -1.0, 1.0), -ray @ _up_further(x[_PITCH]), -turned @ up
        per = 1.0 / np.sqrt(np.maximum(1.0 - down**2, 1e-12))
        off = np.arcsin(down).mean() - self.pitch.pitch_rad
        return np.array([off, *((per * one).mean() for one in slopes)])

    def _pair(self, pair: PairDepth, placed: Sequence[Array], x: Array) -> Term:
        first, second = pair.people
        known = np.flatnonzero(np.isfinite(pair.deviation_m))
        at = [(pair.frames - self.people[number].track.first_frame)[known] for number in pair.people]
        roots = [placed[number][:, rows, -1] for number, rows in zip(pair.people, at, strict=True)]
        middle, across = roots[0][0] + roots[1][0], roots[1][0] - roots[0][0]
        distance = np.linalg.norm(middle, axis=-1, keepdims=True)
        towards = -middle / distance
        nearer = (across * towards).sum(axis=-1)
        # Pairs were looked up at the initial size.
        unit = np.exp(0.5 * (x[_SIZES + first] + x[_SIZES + second])) * pair.deviation_m[known]
        value = nearer / unit - pair.depth_m[known] / pair.deviation_m[known]
        turned = (across - nearer[:, None] * towards) / distance
        one, other = (
            (root * (sign * towards - turned)).sum(axis=-1) / unit
            for sign, root in zip((-1.0, 1.0), roots, strict=True)
        )
        grown = -0.5 * nearer / unit
        stencil = _table(
            self.starts[first] + at[0], self.starts[second] + at[1], _SIZES + first, _SIZES + second, _LENS
        )
        slopes = _table(one[_OWN], other[_OWN], grown, grown, one[_FOCAL] + other[_FOCAL])
        return Term(value, stencil, slopes, is_robust=True, weight=self._alike(first, _PAIR_S))


def _table(*columns: npt.ArrayLike) -> Any:
    """Return columns (n,), or numbers that all rows have, side by side (n, k)."""
    return np.stack(np.broadcast_arrays(*columns), axis=-1)


def estimate_scene(
    people: Sequence[ReconstructedTrack],
    pitch: PitchEstimate,
    *,
    pairs: Sequence[PairDepth] = (),
    statures_m: Mapping[int, float] | None = None,
    camera_height_m: float | None = None,
) -> SceneEstimate:
    """Jointly estimate camera, body sizes and root paths.

    Args:
        people: As the camera sees them, at least one, at initial places; mid-hips before the camera.
        pitch: What the image says of the pitch.
        pairs: What pairs of a database say of couples, by their numbers in `people`.
        statures_m: Stature by person id, where it is known.
        camera_height_m: Height of the camera over the floor where it is known.

    Raises:
        InputError: The height of the camera is not above 0.
    """
    if camera_height_m is not None:
        check_positive(camera_height_m, "the height of the camera")
    problem = _Problem(people, pitch, pairs, statures_m or {}, camera_height_m)
    sides = problem.sides() if camera_height_m is None else [problem.side]
    solutions = []
    for problem.side in sides:
        solutions.append(solve(problem, robust=_ROBUST))
    number = len(sides) - 1 if solutions[-1].cost + _OTHER_SIDE_COST < solutions[0].cost else 0
    problem.side, solution = sides[number], solutions[number]
    tried = {problem.carried: solution}
    for carried in problem.may_carry():
        problem.carried = carried
        tried[carried] = solve(problem, robust=_ROBUST)
    problem.carried = min(tried, key=lambda one: tried[one].cost - (_CARRIED_COST if one is None else 0.0))
    solution = tried[problem.carried]
    x = solution.x
    apart = solve(problem, robust=_ROBUST) if problem.go_on_apart(x) else solution
    return SceneEstimate(
        float(x[_PITCH]),
        float(np.sqrt(solution.variance_of(np.eye(len(x))[_PITCH]))),
        float(problem.pitch_off_rad(x)[0]),
        problem.height_m(x),
        float(np.exp(x[_LENS])),
        np.exp(x[_SIZES : _SIZES + len(people)]),
        tuple(np.exp(x[start:stop]) for start, stop in pairwise(problem.starts)),
        {
            (first, second): float(np.sqrt(np.mean([sum(map(apart.variance_of, one)) for one in weights])))
            for first, second, weights in problem.places_between(apart.x)
        },
    )
