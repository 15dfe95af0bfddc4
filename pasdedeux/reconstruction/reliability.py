"""How good a reconstruction is, without ground truth: of people and of couples a figure, and pass, warn or fail.

The figure is the error to expect, with an interval that holds in 80 % of cases.  That of a person comes from how far
the fit moved the retrieved poses: where the database holds the motion, the image only touches them up; where it does
not, or the camera is not where it was taken to be, they have to give way; from how badly the pitch is known; from how
lively the person moves, because a wrong pose stays wrong while nothing new is seen; and from how far the hips are
turned, because of who faces the camera nothing shows how far the back leans.  What is left of the match's distance when
the image's noise is taken off is compared with that of the database's own motions, each matched against all others:
farther than those, the database lacks the motion.  That of a place, where one of a couple is to the other, comes from
the deviation that the scene's estimate states, from how much farther away one is than the other, which an unknown lens
and unknown sizes stretch, and from what is expected of the poses that it trusts in.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array
from pasdedeux.projections.database import Database
from pasdedeux.projections.search import ProjectionIndex
from pasdedeux.reconstruction.lying import is_on_floor
from pasdedeux.reconstruction.people import ReconstructedPeople
from pasdedeux.reconstruction.pitch import PitchEstimate
from pasdedeux.reconstruction.reconstruct import MEAN_OF_RAYLEIGH, ReconstructedTrack
from pasdedeux.reconstruction.tracks import broken_doubts
from pasdedeux.skeletons import OP14
from pasdedeux.spread import evenly_spread
from pasdedeux.verdict import Level, Verdict

_WEIGHTS = np.array([-2.809, 5.449, -0.28, 3.27, -0.193, 0.188])
"""Of the logarithm of the mean error of a joint: constant, per metre that the fit moved it, per logarithm of the
acceleration of the joints about the mid-hip, per radian of the pitch's deviation, per logarithm of how far the hips are
turned out of the image, and of who lies.  Least squares on 420 people of 238 clips of 4 s, nine families of takes, each
reconstructed without itself: `python -m benchmarks.families DATA --clips 14` prints it of half of them."""
_PLACE_WEIGHTS = np.array([0.526, 0.885])
"""The same of where one is to the other, of 98 couples: constant, and per logarithm of the product of the deviation of
the place and of the root of the error expected of the poses of the two."""
_STRETCH = 0.3
"""Standard deviation of the depth between two people, as a part of it, for the lens: the derivative of their place by
the lens predicts errors less well."""
_MIN_TURNED = 0.1
"""Added to how far the hips are turned, 0 to 1."""
_MIN_ACCELERATION_M_S2, _ACCELERATION_HZ = 0.5, 30.0
"""Added to the acceleration, and the rate of the frames that it is taken from."""
_MAX_EXPECTED_M, _MAX_EXPECTED_PLACE_M = 0.5, 2.0
"""Worse than this nothing was measured."""
_PERSON_RANGE, _PLACE_RANGE = (0.63, 1.45), (0.35, 2.05)
"""What errors of people and of places are as parts of the expected, four times in five, in a family left out of all, as
the scatter within families and between them lets expect."""
_AT_EDGE = 1.5
"""Times as large errors are where the pitch is at the edge of those that were tried: 1.3 to 2.1 of six people seen by
cameras 15 degrees beyond it, and 1.2 to 1.9 by cameras 20 degrees below."""
_OTHERWISE = 2.5
"""The same of people whose image may show something else: 0.9 to 4.4 of 14, where that was so."""
_SIZED, _PLACE_SIZED = 0.88, 0.89
"""Times as large errors are where a stature is stated, and those of places beside what follows from the poses': 0.81 to
0.94, and 0.80 to 0.91 with both, in four families, 56 people and 28 couples."""

DOUBTFUL_ERROR_M, BAD_ERROR_M = 0.09, 0.20
DOUBTFUL_PLACE_M, BAD_PLACE_M = 0.20, 0.40
FAR = 1.5
"""Times the misfit of the database's own motions: farther from it, nothing is to be believed."""
POOR_SHARE_SEEN, USELESS_SHARE_SEEN = 0.7, 0.4
"""Share of the 14 joints that are seen: below the first a person is doubted, below the second useless."""
DOUBTFUL_PITCH_RAD = float(np.deg2rad(5.0))
"""A pitch of a larger standard deviation is doubted: it leans people and tilts the floor."""
MIN_LENGTH_S = 0.5
"""Shorter videos deserve a warning: everything in them errs alike."""
MAX_BRIDGED = 0.2
"""A motion of which more is interpolated deserves a warning."""
LEFT_OUT_PERCENTILE = 95.0
"""Of the database's left-out frames have a misfit no larger than what is still taken for motion that it holds."""

_LEVEL_RAD = float(np.deg2rad(-1.0))
"""A camera that looks up by less is as good as level."""
_NUM_LEFT_OUT, _NUM_NEIGHBOURS = 128, 1000
_HIPS = OP14.indices(["left_hip", "right_hip"])
_GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)
"""Multiples of it lie evenly spread in a turn."""


@dataclass(frozen=True)
class Reliability:
    """Quality of a person's reconstruction, estimated without ground truth.

    Args:
        expected_error_m: Expected mean distance of a joint from the ground truth, mid-hips together; NaN where
            nothing was fitted.
        misfit_m: Median distance of the matches, the image's noise taken off.
        left_out_m: What the database's own motions have at most, 95 % of them; NaN where that is not known.
        share_seen: Share of the joints that were seen.
        share_bridged: Share of the frames that are interpolated.
        doubts: Further reasons for a warning, such as those about the camera.
        farthest_s: Time of the video at which the database is farthest from the image.
        is_unproven: Nothing but the poses of the database says where up is, so that it must not lack the motion.
        evidence: What the logarithm of the expected error is a weighted sum of (n,).
    """

    expected_error_m: float
    misfit_m: float
    left_out_m: float
    share_seen: float
    share_bridged: float
    doubts: tuple[str, ...] = ()
    farthest_s: float = float("nan")
    is_unproven: bool = False
    evidence: Array = field(default_factory=lambda: np.zeros(0), compare=False)

    @property
    def is_lacking(self) -> bool:
        """Tell whether the database lacks the motion."""
        return self.misfit_m > self.left_out_m

    @property
    def expected_in_words(self) -> str:
        """Say the expected error and its interval."""
        return _with_interval(self.expected_error_m, _PERSON_RANGE)

    @property
    def verdict(self) -> Verdict:
        """Pass, warn or fail, and why; of a failure what would help."""
        reasons = []
        is_far = self.expected_error_m > BAD_ERROR_M or self.misfit_m > FAR * self.left_out_m
        is_far |= self.is_unproven and self.is_lacking
        if self.expected_error_m > DOUBTFUL_ERROR_M:
            reasons.append(f"an error of {self.expected_in_words} is expected")
        if self.is_lacking:
            reasons.append(
                f"the database lacks this motion: {100 * self.misfit_m:.1f} cm from the nearest projections, its own "
                f"left-out clips at most {100 * self.left_out_m:.1f}"
            )
        if is_far:
            where = f", it is farthest at {self.farthest_s:.1f} s" if math.isfinite(self.farthest_s) else ""
            reasons.append(f"what would help: takes of such motion in the database{where}, or key frames in 3D")
        if self.share_seen < POOR_SHARE_SEEN:
            reasons.append(f"{self.share_seen:.0%} of the joints are seen")
        if self.share_bridged > MAX_BRIDGED:
            reasons.append(f"{self.share_bridged:.0%} of the frames show too little and are interpolated")
        is_bad = is_far or self.share_seen < USELESS_SHARE_SEEN
        reasons += self.doubts
        level = Level.FAIL if is_bad else Level.WARN if reasons else Level.PASS
        figure = ("expected error", self.expected_error_m, "m")
        return Verdict(level, "; ".join(reasons), *figure, thing="people")


@dataclass(frozen=True)
class Place:
    """Quality of where one person is to the other, estimated without ground truth.

    Args:
        expected_error_m: Expected length by which the vector between the mid-hips is off, mean over frames.
        doubts: Further reasons for a warning, such as those about the camera.
        is_unproven: The video is too short, shows nobody who stands, or may show something else, so that nothing says
            where the camera is.
        evidence: What the logarithm of the expected error is a weighted sum of (n,).
    """

    expected_error_m: float
    doubts: tuple[str, ...] = ()
    is_unproven: bool = False
    evidence: Array = field(default_factory=lambda: np.zeros(0), compare=False)

    @property
    def expected_in_words(self) -> str:
        """Say the expected error and its interval."""
        return _with_interval(self.expected_error_m, _PLACE_RANGE)

    @property
    def verdict(self) -> Verdict:
        """Pass, warn or fail, and what would help."""
        reasons = list(self.doubts)
        if self.expected_error_m > DOUBTFUL_PLACE_M:
            reasons.insert(
                0,
                f"the place of the two is badly known: {self.expected_in_words}; what would help: a stature "
                "(--stature, in a study statures_m), or takes of such couples in the database",
            )
        is_bad = self.is_unproven or self.expected_error_m > BAD_PLACE_M
        level = Level.FAIL if is_bad else Level.WARN if reasons else Level.PASS
        figure = ("expected error of place", self.expected_error_m, "m")
        return Verdict(level, "; ".join(reasons), *figure, thing="couples")


@dataclass(frozen=True)
class Judged:
    """People of a sequence by id, and couples by both ids."""

    people: Mapping[int, Reliability]
    places: Mapping[tuple[int, int], Place]

    @property
    def verdicts(self) -> dict[str, Verdict]:
        """All verdicts, by what they are about."""
        people = {f"person {name}": one.verdict for name, one in self.people.items()}
        return people | {f"place of {a} and {b}": one.verdict for (a, b), one in self.places.items()}


def judge_tracks(
    found: ReconstructedPeople,
    left_out_m: float = float("nan"),
    *,
    sequence_id: str = "",
    pitches_rad: Sequence[float] = (),
) -> Judged:
    """Judge everybody of a sequence, by its last method, and where each is to the partner.

    Args:
        found: What was made of the sequence.
        left_out_m: Misfit that the database's own motions have at most, from `left_out_misfit_m`.
        sequence_id: Its name, for the table of people.
        pitches_rad: Pitches of the cameras that were tried.
    """
    if not found.methods:
        return Judged({}, {})
    made = found.methods[-1].people
    broken = broken_doubts(sequence_id, [one.track for one in made])
    doubts = (*found.doubts, *camera_doubt(pitches_rad, found.pitch))
    longest_s = max(len(one.track.frames) / one.track.rate_hz for one in made)
    if is_short := longest_s < MIN_LENGTH_S:
        doubts = (f"{longest_s:.1f} s are too short to tell camera and places from", *doubts)
    of_one = {
        name: [told[name] for told in (found.otherwise, broken) if name in told]
        for name in (one.track.person_id for one in made)
    }
    at_edge = _AT_EDGE if _is_at_edge(pitches_rad, found.pitch) else 1.0
    people, places = {}, {}
    for one in made:
        name = one.track.person_id
        times = max(at_edge, _OTHERWISE if name in found.otherwise else 1.0) * (_SIZED if found.has_stature else 1.0)
        own = (*doubts, *of_one[name])
        judged = judge_person(
            one, left_out_m, pitch_deviation_rad=found.pitch.deviation_rad, doubts=own, is_unproven=found.pitch.is_guess
        )
        people[name] = replace(judged, expected_error_m=min(times * judged.expected_error_m, _MAX_EXPECTED_M))
    between = {} if found.scene is None else found.scene.place_deviation_m
    for (first, second), deviation_m in between.items():
        couple = made[first].track, made[second].track
        if couple[0].partner_id == couple[1].person_id:
            ids = couple[0].person_id, couple[1].person_id
            expected_m = float(np.mean([people[name].expected_error_m for name in ids]))
            told = [doubt for name in ids for doubt in of_one[name]]
            # Of twelve such couples ten were off by 24 cm and more.
            told += [
                f"person {one.person_id} is not seen upright, and badly placed" for one in couple if is_on_floor(one)
            ]
            own = tuple(dict.fromkeys((*doubts, *told)))
            times = _PLACE_SIZED if found.has_stature else 1.0
            stretched_m = _STRETCH * _depth_between_m(made[first], made[second])
            place = _judge_place(math.hypot(deviation_m, stretched_m), expected_m, own)
            is_unproven = is_short or found.pitch.is_guess or any(name in found.otherwise for name in ids)
            places[ids] = replace(place, expected_error_m=times * place.expected_error_m, is_unproven=is_unproven)
    return Judged(people, places)


def judge_person(
    found: ReconstructedTrack,
    left_out_m: float = float("nan"),
    *,
    pitch_deviation_rad: float = 0.0,
    doubts: Sequence[str] = (),
    is_unproven: bool = False,
) -> Reliability:
    """Judge a person's reconstruction by method `fit`; of another nobody knows what error to expect.

    Args:
        found: ReconstructedTrack.
        left_out_m: Misfit that the database's own motions have at most, from `left_out_misfit_m`.
        pitch_deviation_rad: Standard deviation of the camera's pitch.
        doubts: Further reasons for a warning.
        is_unproven: Nobody is seen standing, so that nothing but the poses says where up is.
    """
    is_known = ~found.is_bridged & np.isfinite(found.score_m)
    noise = MEAN_OF_RAYLEIGH * found.noise_m
    left = np.sqrt(np.maximum(found.score_m[is_known] ** 2 - noise**2, 0.0))
    misfit = float(np.median(left)) if len(left) else float("nan")
    acceleration = np.log(_MIN_ACCELERATION_M_S2 + _acceleration_m_s2(found))
    turned = np.log(_MIN_TURNED + _turned(found))
    lies = float(is_on_floor(found.track))
    evidence = np.array([1.0, _mean(found.correction_m[is_known]), acceleration, pitch_deviation_rad, turned, lies])
    return Reliability(
        expected_error_m=float(np.minimum(np.exp(_WEIGHTS @ evidence), _MAX_EXPECTED_M)),
        misfit_m=misfit,
        left_out_m=left_out_m,
        share_seen=_mean(found.num_joints_seen / OP14.num_joints),
        share_bridged=_mean(found.is_bridged),
        doubts=tuple(doubts),
        farthest_s=float(found.track.times_s[is_known][np.argmax(left)]) if len(left) else float("nan"),
        is_unproven=is_unproven,
        evidence=evidence,
    )


def _judge_place(deviation_m: float, expected_m: float, doubts: tuple[str, ...]) -> Place:
    """Judge the place of two people by its deviation, and the error to expect of their poses where that is known."""
    if not math.isfinite(expected_m):
        return Place(deviation_m, doubts)
    evidence = np.array([1.0, np.log(deviation_m * math.sqrt(expected_m))])
    expected = float(np.minimum(np.exp(_PLACE_WEIGHTS @ evidence), _MAX_EXPECTED_PLACE_M))
    return Place(expected, doubts, evidence=evidence)


def left_out_misfit_m(database: Database, index: ProjectionIndex, motion: npt.NDArray[np.object_]) -> float:
    """Return the misfit that frames of the database have at most when their own motion is left out, 95 % of them.

    The frames are evenly spread, and so are the yaws: whoever asks of one database gets one answer.

    Args:
        database: Database.
        index: Its index.
        motion: Name of the motion of each row, (row,), such as its take: rows of one name are left out together.

    Returns:
        Metres; NaN where all rows have one name.  A frame whose nearest rows are all of its own motion counts with
        the distance of the farthest of those, which is too small rather than too large.
    """
    if len(np.unique(motion.astype(str))) < 2:
        return float("nan")
    rows = evenly_spread(database.num_rows, _NUM_LEFT_OUT)
    yaw = database.num_yaws * np.mod(_GOLDEN * np.arange(len(rows)), 1.0)
    query = database.camera.project(database.turned(rows, yaw))
    found = index.search(query, num_neighbours=_NUM_NEIGHBOURS)
    is_other = (found.row >= 0) & (motion[np.maximum(found.row, 0)] != motion[rows][:, None])
    reached = np.where(np.isfinite(found.distance_m), found.distance_m, 0.0).max(axis=1)
    nearest = np.where(is_other, found.distance_m, np.inf).min(axis=1)
    return float(np.percentile(np.minimum(nearest, reached), LEFT_OUT_PERCENTILE))


def camera_doubt(pitches_rad: Sequence[float], pitch: PitchEstimate) -> tuple[str, ...]:
    """Say whether the camera's pitch was found at the edge of those that were tried, or is badly known.

    A level camera is no edge: few look up at people.
    """
    if pitch.is_guess:
        how = "--pitch, in a study projections.pitches_deg"
        return (f"nobody is seen standing, so that {pitch.in_words()} is a guess: state it ({how})",)
    if len(pitches_rad) < 2:
        return ()
    if _is_at_edge(pitches_rad, pitch):
        return (f"{pitch.in_words()}, at the edge of what was tried: it may be more, or wrong",)
    return (f"{pitch.in_words()}",) if pitch.deviation_rad > DOUBTFUL_PITCH_RAD else ()


def _is_at_edge(pitches_rad: Sequence[float], pitch: PitchEstimate) -> bool:
    """Tell whether a pitch lies where none was tried beyond."""
    if len(pitches_rad) < 2 or pitch.is_given:
        return False
    return pitch.pitch_rad >= max(pitches_rad) or pitch.pitch_rad <= min(*pitches_rad, _LEVEL_RAD)


def _acceleration_m_s2(found: ReconstructedTrack) -> float:
    """Return the mean acceleration of the joints about the mid-hip; 0 of fewer than three frames."""
    step = max(1, round(found.track.rate_hz / _ACCELERATION_HZ))
    poses = (found.positions_m - found.root_m[:, None])[::step]
    if len(poses) < 3:
        return 0.0
    bend = np.linalg.norm(np.diff(poses, n=2, axis=0), axis=-1)
    return float(bend.mean()) * (found.track.rate_hz / step) ** 2


def _turned(found: ReconstructedTrack) -> float:
    """Return how far the line between the hips is turned out of the image, 0 to 1, on average."""
    across = np.diff(found.positions_m[:, _HIPS], axis=1)[:, 0]
    return _mean(np.abs(across[:, 2]) / np.maximum(np.linalg.norm(across, axis=-1), 1e-9))


def _depth_between_m(one: ReconstructedTrack, other: ReconstructedTrack) -> float:
    """Return how much farther away one is than the other, mean over the frames that show both."""
    _, at, there = np.intersect1d(one.track.frames, other.track.frames, return_indices=True)
    return _mean(np.abs(one.root_m[at, 2] - other.root_m[there, 2]))


def _with_interval(error_m: float, parts: tuple[float, float]) -> str:
    if not math.isfinite(error_m):
        return ""
    low, high = (100.0 * error_m * part for part in parts)
    return f"{100.0 * error_m:.0f} cm ({low:.0f} to {high:.0f})"


def _mean(values: npt.ArrayLike) -> float:
    found = np.asarray(values, dtype=np.float64)
    return float(found.mean()) if found.size else float("nan")
