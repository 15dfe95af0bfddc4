"""One world for all people of a video: camera pitch and height, everybody's size, and where everybody is, at once.

One camera sees in which direction a person is and how large the person looks.  How far away that is depends on the
lens, on how large the person really is and, on a floor, on where the camera stands.  All of it is one robust least
squares over the pitch, the camera's height, the focal length, the sizes, and the logarithm l(t) of each person's
distance over the one first thought of:

- l(t) = log size + log focal, as the person looks in the image;
- of who stands, the lower ankle is on the floor; nobody is below it, who is held above it is let go of;
- a foot that stands does not move in depth, and paths are smooth;
- two bodies do not pass through each other, and a hand that for long keeps its place on a bone of the other's image
  touches it there;
- pairs of the database that look like both say how far apart in depth people stand who are seen so;
- sizes are people's, the lens is a common one, and the pitch is near the one whose poses fit the image best.

Errors of poses last: frames near each other in time count as one, in every term that poses enter.
Robust terms are weighed anew in each step of the solver: who stands is decided with everything else.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise

import numpy as np
import numpy.typing as npt
from pydantic import Field

from pasdedeux.arrays import Array
from pasdedeux.errors import InputError
from pasdedeux.interaction.surfaces import surface_gaps
from pasdedeux.kinematics.forward import bone_lengths
from pasdedeux.kinematics.rotations import conjugate, rotate
from pasdedeux.plausibility.capsules import body_height_m, capsule_model
from pasdedeux.reconstruction.bones import bone_rotations
from pasdedeux.reconstruction.couples import PairDepth
from pasdedeux.reconstruction.pitch import PitchEstimate
from pasdedeux.reconstruction.rays import camera_turns
from pasdedeux.reconstruction.reconstruct import Reconstruction
from pasdedeux.reconstruction.robust import Term, solve
from pasdedeux.settings import Settings
from pasdedeux.skeletons import OP14

Integers = npt.NDArray[np.int64]

_ANKLES = np.array([leg[2] for leg in OP14.legs])
_ANKLE_HEIGHT = 0.04
"""Height of the ankle over the floor, standing, as a part of the stature (Winter 2009, fig. 4.1: 0.039)."""
_PITCH, _HEIGHT, _LENS, _TILT, _SIZES = 0, 1, 2, 3, 4
_GIVEN_RAD = 1e-3
"""Deviation of a pitch that was stated."""
_HANDS = [
    place for place, (_, child) in enumerate(OP14.bones) if OP14.joint_names[child] in ("left_wrist", "right_wrist")
]


class WorldSettings(Settings):
    """What is believed of a camera, of people and of the image; deviations are standard deviations."""

    stature_m: float = Field(
        1.68,
        gt=0,
        description="People are about so tall: the mean of women (1.61 m) and men (1.75 m; Fryar et al. 2021)",
    )
    size_deviation: float = Field(0.06, gt=0, description="Deviation of the log of their stature")
    known_deviation: float = Field(0.01, gt=0, description="The same of a stature, a height or a lens that is known")
    lens_deviation: float = Field(0.3, gt=0, description="Deviation of the log of the focal length from the assumed")
    camera_height_m: float = Field(1.5, gt=0, description="Cameras stand about so high over the floor")
    height_deviation: float = Field(0.6, gt=0, description="Deviation of the log of that")
    look_deviation: float = Field(0.05, gt=0, description="Deviation of how large a person looks: poses differ")
    look_s: float = Field(1.0, gt=0, description="Frames nearer in time than this count as one: they err alike")
    floor_deviation_m: float = Field(0.045, gt=0, description="Deviation of the lower ankle from where it stands")
    ankle_deviation_m: float = Field(0.02, gt=0, description="The same of a person all the time: shoes and heels")
    tilt_deviation: float = Field(
        0.04, gt=0, description="Deviation of the slope that errors of the poses in depth give the floor"
    )
    floor_s: float = Field(0.7, gt=0, description="The same of errors of the ankle's height")
    stance_m_s: float = Field(0.3, gt=0, description="Deviation of the depth speed of a foot that stands")
    still_m_s: float = Field(0.3, gt=0, description="Feet slower than this across the image stand")
    acceleration_m_s2: float = Field(8.0, gt=0, description="Deviation of the second derivative of a person's distance")
    pair_s: float = Field(0.5, gt=0, description="Frames nearer in time than this count as one for the pairs")
    touch_deviation_m: float = Field(0.08, gt=0, description="Deviation of the gap of two people who touch")
    touch_image_m: float = Field(0.03, gt=0, description="Hands no further from the other's image may touch")
    touch_s: float = Field(3.0, gt=0, description="if they stay there so long")
    touch_keep_m: float = Field(0.1, gt=0, description="and move along the bone by no more than this")
    gap_deviation_m: float = Field(0.05, gt=0, description="Deviation of how far two bodies pass through each other")
    robust: float = Field(3.0, gt=0, description="At so many deviations a residual counts a quarter (Geman, McClure)")


@dataclass(frozen=True)
class Seen:
    """A person as the camera sees them.

    Args:
        first_frame: Frame of the sequence that the track begins with.
        found: Reconstruction with a first thought of its place, camera axes, camera at the origin.
        rate_hz: Frames per second.
        stature_m: Stature where it is known.
    """

    first_frame: int
    found: Reconstruction
    rate_hz: float
    stature_m: float | None = None

    @property
    def frames(self) -> Integers:
        """Frames of the sequence (frame,)."""
        return self.first_frame + np.arange(len(self.found.root_m))


@dataclass(frozen=True)
class World:
    """Everybody in one world.

    Args:
        pitch_rad: Pitch of the camera.
        pitch_deviation_rad: Standard deviation of it, from the curvature of what was solved.
        camera_height_m: Height of the camera over the floor.
        lens_factor: Focal length over the assumed one.
        sizes: Of each person against the first thought (person,).
        factors: Of the distance of each person's mid-hip from the camera, against the first thought, (frame,) each.
    """

    pitch_rad: float
    pitch_deviation_rad: float
    camera_height_m: float
    lens_factor: float
    sizes: Array
    factors: tuple[Array, ...]

    def moved(self, number: int, found: Reconstruction) -> Reconstruction:
        """Return the reconstruction of a person at its place and size, on the rays of this lens, pose kept."""
        length = np.linalg.norm(found.root_m, axis=-1)
        ray = _rays(found.root_m[:, :2] / -found.root_m[:, 2:], self.lens_factor)
        root = (length * self.factors[number])[:, None] * ray
        relative = rotate(camera_turns(-ray)[:, None], _relative(found)) * self.sizes[number]
        positions = root[:, None] + relative
        return replace(
            found,
            positions_m=positions,
            root_m=root,
            bone_unitquat=bone_rotations(positions),
            metres_per_pixel=found.metres_per_pixel * self.factors[number] / self.lens_factor,
        )


def _up(pitch_rad: float) -> Array:
    """Return the direction upwards in the axes of a camera of this pitch."""
    return np.array([0.0, np.cos(pitch_rad), np.sin(pitch_rad)])


def _rays(plane: Array, lens_factor: float) -> Array:
    """Return unit directions (n, 3) from the camera through points (n, 2) of an image one focal length away."""
    rays = np.concatenate([plane / lens_factor, -np.ones((len(plane), 1))], axis=1)
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def _relative(found: Reconstruction) -> Array:
    """Return poses (frame, 14, 3) about the mid-hip as a camera turned to it sees them."""
    towards = -found.root_m / np.linalg.norm(found.root_m, axis=-1, keepdims=True)
    return rotate(conjugate(camera_turns(towards))[:, None], found.positions_m - found.root_m[:, None])


def _of_hands(first: Array, second: Array | None = None) -> Array:
    """Return what (frame, bone of A, bone of B) is of A's hands and every bone of B, B's hands and every one of A."""
    second = first if second is None else second
    return np.concatenate([first[:, _HANDS], second[:, :, _HANDS].swapaxes(1, 2)], axis=1)


class _Problem:
    """The residuals of `estimate_world` as a function of all unknowns."""

    def __init__(
        self,
        people: Sequence[Seen],
        pitch: PitchEstimate,
        pairs: Sequence[PairDepth],
        settings: WorldSettings,
    ) -> None:
        self.people, self.pairs, self.settings = people, pairs, settings
        self.pitch = pitch
        counts = [len(one.found.root_m) for one in people]
        self.num_globals = _SIZES + 2 * len(people)
        self.starts = self.num_globals + np.concatenate([[0], np.cumsum(counts)])
        self.distance = [np.linalg.norm(one.found.root_m, axis=-1) for one in people]
        self.mean_distance = float(np.mean(np.concatenate(self.distance)))
        self.plane = [one.found.root_m[:, :2] / -one.found.root_m[:, 2:] for one in people]
        self.images = [one.found.positions_m[..., :2] / -one.found.positions_m[..., 2:] for one in people]
        self.relative = [_relative(one.found) for one in people]
        lengths = [np.median(bone_lengths(OP14, one.found.positions_m), axis=0) for one in people]
        self.stature = np.array([float(body_height_m(OP14, one)) for one in lengths])
        known = [one.stature_m is not None for one in people]
        self.wanted_stature = np.array([one.stature_m or settings.stature_m for one in people])
        self.size_deviation = np.where(known, settings.known_deviation, settings.size_deviation)
        self.radii = capsule_model(OP14).radii_m(self.stature)
        self.still = [self._still(one) for one in people]
        start = np.zeros(self.starts[-1])
        start[_PITCH], start[_HEIGHT] = pitch.pitch_rad, np.log(settings.camera_height_m)
        for number in np.flatnonzero(known):
            size = np.log(self.wanted_stature[number] / self.stature[number])
            start[_SIZES + number] = start[self.starts[number] : self.starts[number + 1]] = size
        self.start = start
        # Distances of frames next to each other and of the two people of a pair differ in colour.
        colours = [3 * number + np.arange(count) % 3 for number, count in enumerate(counts)]
        self.colour = np.concatenate([np.arange(self.num_globals) + 3 * len(people), *colours])
        self.near = [
            (first, second, *self._common(first, second)) for first, second in combinations(range(len(people)), 2)
        ]
        self.touching = {(first, second): self._touching(first, second, *at) for first, second, *at in self.near}

    def _still(self, one: Seen) -> Array:
        """Return how much each foot stands by the image alone (frame, foot)."""
        ankles = one.found.positions_m[:, _ANKLES, :2]
        if len(ankles) < 2:
            return np.zeros(ankles.shape[:2])
        speed = np.linalg.norm(np.gradient(ankles, axis=0), axis=-1) * one.rate_hz
        return np.where(one.found.is_bridged[:, None], 0.0, 1.0 / (1.0 + (speed / self.settings.still_m_s) ** 4))

    def _touching(self, first: int, second: int, one_at: Integers, other_at: Integers) -> npt.NDArray[np.bool_]:
        """Return on which bones of the other each hand (frame, A's two and B's two, bone) keeps its place in the image.

        A hand that only passes before the other, or dances there, moves along the bone.
        """
        from scipy.ndimage import maximum_filter1d, minimum_filter1d  # here: 0.2 s that planning does not need

        both = np.stack(
            [self.people[n].found.positions_m[at] for n, at in ((first, one_at), (second, other_at))], axis=1
        )
        if not len(both):
            return np.zeros((0, 2 * len(_HANDS), len(OP14.bones)), dtype=bool)
        lengths = np.median(np.stack([bone_lengths(OP14, both[:, n]) for n in (0, 1)]), axis=1)
        depth = -both[..., 2].mean(axis=(1, 2))
        flat = both / -both[..., 2:] * depth[:, None, None, None]
        flat[..., 2] = 0.0
        between = surface_gaps(flat, self.radii[[first, second]], OP14)
        gap = _of_hands(between.gap_m)
        along = _of_hands(between.share[..., 1], between.share[..., 0])
        along = along * lengths[[1, 1, 0, 0]][:, between.bones]
        length = 2 * round(0.5 * self.settings.touch_s * self.people[first].rate_hz) + 1
        high, low = (op(along, length, axis=0) for op in (maximum_filter1d, minimum_filter1d))
        stays = maximum_filter1d(gap, length, axis=0) < self.settings.touch_image_m
        stays &= high - low < self.settings.touch_keep_m
        return maximum_filter1d(stays.astype(np.uint8), length, axis=0).astype(bool)

    def _common(self, first: int, second: int) -> tuple[Integers, Integers]:
        """Return where the frames that two people share lie in the track of each."""
        frames = np.intersect1d(self.people[first].frames, self.people[second].frames)
        return frames - self.people[first].first_frame, frames - self.people[second].first_frame

    def places(self, x: Array, number: int) -> tuple[Array, Array]:
        """Return mid-hips (frame, 3) and positions (frame, 14, 3) of a person, camera axes."""
        ray = _rays(self.plane[number], float(np.exp(x[_LENS])))
        own = slice(self.starts[number], self.starts[number + 1])
        root = (self.distance[number] * np.exp(x[own]))[:, None] * ray
        relative = rotate(camera_turns(-ray)[:, None], self.relative[number]) * np.exp(x[_SIZES + number])
        # Every joint stays on its own ray, whatever the lens.
        depth = root[:, None, 2:] + relative[..., 2:]
        return root, np.concatenate([-depth * self.images[number] * np.exp(-x[_LENS]), depth], axis=-1)

    def terms(self, x: Array) -> list[Term]:
        """Return the residuals at these unknowns."""
        one = self.settings
        terms = [self._priors(x)]
        placed = [self.places(x, number) for number in range(len(self.people))]
        up, height = _up(x[_PITCH]), np.exp(x[_HEIGHT])
        for number, (seen, (_, positions)) in enumerate(zip(self.people, placed, strict=True)):
            at = np.arange(self.starts[number], self.starts[number + 1])
            known = np.flatnonzero(~seen.found.is_bridged)
            alike = 1.0 / max(1.0, one.look_s * seen.rate_hz)
            looks = (x[at] - x[_SIZES + number] - x[_LENS]) / one.look_deviation
            terms.append(Term(looks[known], at[known, None], np.ones(len(known), dtype=bool), alike))
            ankles = positions[:, _ANKLES]
            stands = _ANKLE_HEIGHT * self.stature[number] * np.exp(x[_SIZES + number])
            above = ankles @ up + height - stands - x[_SIZES + len(self.people) + number]
            # What poses err in depth tilts the floor, which is not the pitch.
            above = above + x[_TILT] * (ankles[..., 2] + self.mean_distance)
            alike = 1.0 / max(1.0, one.floor_s * seen.rate_hz)
            # Errors of poses grow with people: whoever is small gains nothing by it.
            size = np.exp(x[_SIZES + number])
            floor = above.min(axis=1) / (size * one.floor_deviation_m)
            terms.append(Term(floor[known], at[known, None], floor[known] > 0, alike))
            if len(at) > 2:
                distance = self.distance[number] * np.exp(x[at] - x[_SIZES + number])
                bend = np.diff(distance, n=2) * seen.rate_hz**2 / one.acceleration_m_s2
                terms.append(Term(bend, np.stack([at[:-2], at[1:-1], at[2:]], axis=1), np.zeros(len(bend), bool)))
                still = np.sqrt(np.minimum(self.still[number][1:], self.still[number][:-1]))
                lower = np.argmin(above, axis=1)[1:]
                rows = np.arange(len(lower))
                step = np.diff(ankles[..., 2], axis=0)[rows, lower] * seen.rate_hz / (size * one.stance_m_s)
                terms.append(
                    Term(
                        still[rows, lower] * step,
                        np.stack([at[:-1], at[1:]], axis=1),
                        np.ones(len(step), bool),
                        alike,
                    )
                )
        for pair in self.pairs:
            terms.append(self._pair(pair, placed, x))
        for first, second, one_at, other_at in self.near:
            if not len(one_at):
                continue
            both = np.stack([placed[first][1][one_at], placed[second][1][other_at]], axis=1)
            size = np.exp(x[[_SIZES + first, _SIZES + second]])
            between = surface_gaps(both, self.radii[[first, second]] * size[:, None], OP14).gap_m
            gaps = between.min(axis=(1, 2))
            stencil = np.stack([self.starts[first] + one_at, self.starts[second] + other_at], axis=1)
            alike = 1.0 / max(1.0, one.floor_s * self.people[first].rate_hz)
            through = np.minimum(gaps, 0.0) / (size.mean() * one.gap_deviation_m)
            terms.append(Term(through, stencil, np.zeros(len(gaps), bool), alike))
            touching = self.touching[first, second]
            hands = np.where(touching, _of_hands(between), np.inf).min(axis=2)
            rows, hand = np.nonzero(touching.any(axis=2))
            touch = np.maximum(hands[rows, hand], 0.0) / (size.mean() * one.touch_deviation_m)
            terms.append(Term(touch, stencil[rows], np.ones(len(rows), bool), alike))
        return terms

    def _priors(self, x: Array) -> Term:
        one = self.settings
        sizes = np.log(self.stature / self.wanted_stature) + x[_SIZES : _SIZES + len(self.people)]
        value = np.concatenate(
            [
                [self._pitch_of_image(x)],
                [(x[_HEIGHT] - np.log(one.camera_height_m)) / one.height_deviation],
                [x[_LENS] / one.lens_deviation],
                sizes / self.size_deviation,
                [x[_TILT] / one.tilt_deviation],
                x[_SIZES + len(self.people) : self.num_globals] / one.ankle_deviation_m,
            ]
        )
        return Term(value, np.zeros((len(value), 0), dtype=np.int64), np.zeros(len(value), bool))

    def _pitch_of_image(self, x: Array) -> float:
        """Return how far the pitch is off, in deviations: that of the rays to people is what suits their image."""
        if self.pitch.is_given:
            return float((x[_PITCH] - self.pitch.pitch_rad) / _GIVEN_RAD)
        known = [plane[~seen.found.is_bridged] for plane, seen in zip(self.plane, self.people, strict=True)]
        down = -_rays(np.concatenate(known), float(np.exp(x[_LENS]))) @ _up(x[_PITCH])
        off = np.arcsin(np.clip(down, -1.0, 1.0)).mean() - self.pitch.pitch_rad
        return float(off / self.pitch.deviation_rad)

    def _pair(self, pair: PairDepth, placed: Sequence[tuple[Array, Array]], x: Array) -> Term:
        first, second = pair.people
        at = [pair.frames - self.people[number].first_frame for number in pair.people]
        roots = [placed[number][0][rows] for number, rows in zip(pair.people, at, strict=True)]
        middle = roots[0] + roots[1]
        towards = -middle / np.linalg.norm(middle, axis=-1, keepdims=True)
        nearer = ((roots[1] - roots[0]) * towards).sum(axis=-1)
        known = np.flatnonzero(np.isfinite(pair.deviation_m))
        alike = 1.0 / max(1.0, self.settings.pair_s * self.people[first].rate_hz)
        # Pairs were looked up at the size first thought of.
        size = np.exp(0.5 * (x[_SIZES + first] + x[_SIZES + second]))
        value = (nearer / size - pair.depth_m)[known] / pair.deviation_m[known]
        stencil = np.stack([self.starts[first] + at[0], self.starts[second] + at[1]], axis=1)[known]
        return Term(value, stencil, np.ones(len(known), bool), alike)


def estimate_world(
    people: Sequence[Seen],
    pitch: PitchEstimate,
    *,
    pairs: Sequence[PairDepth] = (),
    camera_height_m: float | None = None,
    is_lens_known: bool = False,
    settings: WorldSettings | None = None,
) -> World:
    """Return where everybody is in one world.

    Args:
        people: As the camera sees them, at least one; mid-hips before the camera.
        pitch: What the image says of the pitch.
        pairs: What pairs of a database say of couples, by their numbers in `people`.
        camera_height_m: Height of the camera over the floor where it is known.
        is_lens_known: The focal length was stated, not assumed.
        settings: What is believed.

    Raises:
        InputError: The height is not positive.
    """
    settings = settings or WorldSettings()
    if camera_height_m is not None:
        if not (np.isfinite(camera_height_m) and camera_height_m > 0):
            raise InputError(f"the height of the camera over the floor is {camera_height_m} m; it must be positive")
        known = {"camera_height_m": camera_height_m, "height_deviation": settings.known_deviation}
        settings = settings.model_copy(update=known)
    if is_lens_known:
        settings = settings.model_copy(update={"lens_deviation": settings.known_deviation})
    problem = _Problem(people, pitch, pairs, settings)
    x, variance = solve(problem, robust=settings.robust, variance_of=_PITCH)
    return World(
        float(x[_PITCH]),
        float(np.sqrt(variance)),
        float(np.exp(x[_HEIGHT])),
        float(np.exp(x[_LENS])),
        np.exp(x[_SIZES : _SIZES + len(people)]),
        tuple(np.exp(x[start:stop]) for start, stop in pairwise(problem.starts)),
    )
