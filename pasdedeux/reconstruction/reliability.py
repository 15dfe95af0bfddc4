"""Judge a reconstruction without ground truth: a figure for each person and couple, and pass, warn or fail.

The figure is the expected error, with an interval that holds in 80 % of cases.  For a person, it follows from

- how far the fit moved the retrieved poses: little if the database holds the motion and the camera is right;
- the deviation of the pitch;
- the acceleration of the joints, because a wrong pose stays wrong while the person keeps still;
- the turn of the hips, because the image does not show how far the back of a person who faces the camera leans.

The distance of the matches, less the noise of the image, is compared with that of the database's own motions, each
matched to the others.  If it is larger, the database lacks the motion.

For the place of one person of a couple relative to the other, the figure follows from the deviation by the scene
estimate, from the depth between the two, which an unknown lens and unknown sizes stretch, and from the expected errors
of both poses.
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
from pasdedeux.reconstruction.moving_camera import moving_camera_doubt
from pasdedeux.reconstruction.people import ReconstructedPeople
from pasdedeux.reconstruction.pitch import PitchEstimate
from pasdedeux.reconstruction.reconstruct import MEAN_OF_RAYLEIGH, ReconstructedTrack
from pasdedeux.reconstruction.tracks import broken_doubts
from pasdedeux.skeletons import OP14
from pasdedeux.spread import evenly_spread
from pasdedeux.verdict import Level, Verdict

_WEIGHTS = np.array([-2.809, 5.449, -0.28, 3.27, -0.193, 0.188])
"""Weights of the log of the mean error of a joint: constant, per metre that the fit moved it, per log of the
acceleration of the joints about the mid-hip, per radian of the pitch's deviation, per log of how far the hips are
turned out of the image, and for people on the floor.  Least squares on 420 people of 238 clips of 4 s, nine families of
takes, each reconstructed without itself: `python -m benchmarks.families DATA --clips 14` prints it of half of them."""
_PLACE_WEIGHTS = np.array([0.526, 0.885])
"""The same for places, of 98 couples: constant, and per log of the product of the deviation of the place and the root
of the expected error of both poses."""
_STRETCH = 0.3
"""Standard deviation of the depth between two people, as a part of it, for the lens: the derivative of their place by
the lens predicts errors less well."""
_MIN_TURNED = 0.1
"""Added to the turn of the hips, 0 to 1."""
_MIN_ACCELERATION_M_S2, _ACCELERATION_HZ = 0.5, 30.0
"""Added to the acceleration, and the rate of the frames from which it is taken."""
_MAX_EXPECTED_M, _MAX_EXPECTED_PLACE_M = 0.5, 2.0
"""Largest measured errors."""
_PERSON_RANGE, _PLACE_RANGE = (0.63, 1.45), (0.35, 2.05)
"""Interval of the error over the expected error, for people and places; holds in 80 % of clips of a left-out family."""
_AT_EDGE = 1.5
"""Factor on errors if the pitch is at the edge of those tried: 1.3 to 2.1 for six people before cameras 15 degrees
beyond it, and 1.2 to 1.9 before cameras 20 degrees below."""
_OTHERWISE = 2.5
"""Factor on errors of people whose image is ambiguous: 0.9 to 4.4 for 14 whose image did show something else."""
_SIZED, _PLACE_SIZED = 0.88, 0.89
"""Factors on errors if a stature is stated: for people 0.81 to 0.94, and on top for places, 0.80 to 0.91 with both, in
four families, 56 people and 28 couples."""

DOUBTFUL_ERROR_M, BAD_ERROR_M = 0.09, 0.20
DOUBTFUL_PLACE_M, BAD_PLACE_M = 0.20, 0.40
FAR = 1.5
"""Largest misfit, as a multiple of that of the database's own motions, before a failure."""
POOR_SHARE_SEEN, USELESS_SHARE_SEEN = 0.7, 0.4
"""Shares of seen joints: a warning below the first, a failure below the second."""
DOUBTFUL_PITCH_RAD = float(np.deg2rad(5.0))
"""A larger standard deviation of the pitch is a warning: a wrong pitch leans people and tilts the floor."""
MIN_LENGTH_S = 0.5
"""Shorter videos get a warning, because the errors of all their frames are alike."""
MAX_BRIDGED = 0.2
"""A motion of which a larger share is interpolated gets a warning."""
LEFT_OUT_PERCENTILE = 95.0
"""Percentile of the misfits of left-out frames up to which the database holds a motion."""

_LEVEL_RAD = float(np.deg2rad(-1.0))
"""A camera that looks up by less counts as level."""
_NUM_LEFT_OUT, _NUM_NEIGHBOURS = 128, 1000
_HIPS = OP14.indices(["left_hip", "right_hip"])
_GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)
"""Multiples of it are evenly spread over a turn."""


@dataclass(frozen=True)
class Reliability:
    """Quality of a person's reconstruction, estimated without ground truth.

    Args:
        expected_error_m: Expected mean distance of a joint from the ground truth, mid-hips aligned; NaN without a fit.
        misfit_m: Median distance of the matches, less the noise of the image.
        left_out_m: The misfit of the database's own motions, 95th percentile; NaN if unknown.
        share_seen: Share of seen joints.
        share_bridged: Share of interpolated frames.
        doubts: Further reasons for a warning, such as those about the camera.
        farthest_s: Time of the video at which the database is farthest from the image.
        is_unproven: Whether only the poses of the database determine the pitch, so that it must hold the motion.
        is_moved: Whether the camera seems to move, which is taken for motion of the people.
        evidence: The log of the expected error is a weighted sum of these (n,).
    """

    expected_error_m: float
    misfit_m: float
    left_out_m: float
    share_seen: float
    share_bridged: float
    doubts: tuple[str, ...] = ()
    farthest_s: float = float("nan")
    is_unproven: bool = False
    is_moved: bool = False
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
        """Pass, warn or fail, the reasons, and for a failure what would help."""
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
        is_bad = is_far or self.is_moved or self.share_seen < USELESS_SHARE_SEEN
        reasons += self.doubts
        level = Level.FAIL if is_bad else Level.WARN if reasons else Level.PASS
        figure = ("expected error", self.expected_error_m, "m")
        return Verdict(level, "; ".join(reasons), *figure, thing="people")


@dataclass(frozen=True)
class PlaceReliability:
    """Quality of the place of one person relative to the other, estimated without ground truth.

    Args:
        expected_error_m: Expected error of the vector between the mid-hips, mean over frames.
        doubts: Further reasons for a warning, such as those about the camera.
        is_unproven: Whether nothing determines the camera: the video is too short or ambiguous, nobody stands, or the
            camera moves.
        evidence: The log of the expected error is a weighted sum of these (n,).
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
    places: Mapping[tuple[int, int], PlaceReliability]

    @property
    def verdicts(self) -> dict[str, Verdict]:
        """All verdicts, by their subject."""
        people = {f"person {name}": person.verdict for name, person in self.people.items()}
        return people | {f"place of {a} and {b}": place.verdict for (a, b), place in self.places.items()}

    @property
    def verdicts_with_errors(self) -> dict[str, Verdict]:
        """All verdicts, by their subject and its expected error."""
        expected = [person.expected_in_words for person in self.people.values()]
        expected += [place.expected_in_words for place in self.places.values()]
        named = zip(self.verdicts.items(), expected, strict=True)
        return {f"{name}, expected error {words}": verdict for (name, verdict), words in named}


def judge_tracks(
    people: ReconstructedPeople,
    left_out_m: float = float("nan"),
    *,
    sequence_id: str = "",
    pitches_rad: Sequence[float] = (),
) -> Judged:
    """Judge the people of a sequence, by the last method, and the place of each relative to the partner.

    Args:
        people: The people.
        left_out_m: Largest misfit of the database's own motions, from `left_out_misfit_m`.
        sequence_id: Name of the sequence, for the table of people.
        pitches_rad: Pitches that were tried.
    """
    if not people.methods:
        return Judged({}, {})
    reconstructed, pitch = people.methods[-1].people, people.pitch
    longest_s = max(len(person.track.frames) / person.track.rate_hz for person in reconstructed)
    is_short = longest_s < MIN_LENGTH_S
    shared = [f"{longest_s:.1f} s are too short to tell camera and places from"] if is_short else []
    moved = moving_camera_doubt([person.track for person in reconstructed])
    shared += [moved] * bool(moved) + [*people.doubts, *camera_doubt(pitches_rad, pitch)]
    broken = broken_doubts(sequence_id, [person.track for person in reconstructed])
    doubts = {
        name: [warnings[name] for warnings in (people.otherwise, broken) if name in warnings]
        for name in (person.person_id for person in reconstructed)
    }
    at_edge = _AT_EDGE if _is_at_edge(pitches_rad, pitch) else 1.0
    judged: dict[int, Reliability] = {}
    for person in reconstructed:
        name = person.person_id
        reliability = judge_person(
            person,
            left_out_m,
            pitch_deviation_rad=pitch.deviation_rad,
            doubts=(*shared, *doubts[name]),
            is_unproven=pitch.is_guess,
        )
        factor = max(at_edge, _OTHERWISE if name in people.otherwise else 1.0) * (_SIZED if people.has_stature else 1.0)
        expected_m = min(factor * reliability.expected_error_m, _MAX_EXPECTED_M)
        judged[name] = replace(reliability, expected_error_m=expected_m, is_moved=bool(moved))
    places: dict[tuple[int, int], PlaceReliability] = {}
    between = {} if people.scene is None else people.scene.place_deviation_m
    for numbers, deviation_m in between.items():
        first, second = (reconstructed[number] for number in numbers)
        if first.track.partner_id != second.person_id:
            continue
        ids = first.person_id, second.person_id
        of_both = [doubt for name in ids for doubt in doubts[name]]
        # Of twelve such couples ten were off by 24 cm and more.
        of_both += [
            f"person {person.person_id} is not seen upright, and badly placed"
            for person in (first, second)
            if is_on_floor(person.track)
        ]
        place = _judge_place(
            math.hypot(deviation_m, _STRETCH * _depth_between_m(first, second)),
            float(np.mean([judged[name].expected_error_m for name in ids])),
            tuple(dict.fromkeys((*shared, *of_both))),
        )
        places[ids] = replace(
            place,
            expected_error_m=(_PLACE_SIZED if people.has_stature else 1.0) * place.expected_error_m,
            is_unproven=is_short or bool(moved) or pitch.is_guess or any(name in people.otherwise for name in ids),
        )
    return Judged(judged, places)


def judge_person(
    person: ReconstructedTrack,
    left_out_m: float = float("nan"),
    *,
    pitch_deviation_rad: float = 0.0,
    doubts: Sequence[str] = (),
    is_unproven: bool = False,
) -> Reliability:
    """Judge a person's reconstruction by method `fit`; for other methods the expected error is NaN.

    Args:
        person: The person.
        left_out_m: Largest misfit of the database's own motions, from `left_out_misfit_m`.
        pitch_deviation_rad: Standard deviation of the camera's pitch.
        doubts: Further reasons for a warning.
        is_unproven: Whether nobody is seen standing, so that only the poses determine the pitch.
    """
    is_known = ~person.is_bridged & np.isfinite(person.score_m)
    noise = MEAN_OF_RAYLEIGH * person.noise_m
    left = np.sqrt(np.maximum(person.score_m[is_known] ** 2 - noise**2, 0.0))
    misfit = float(np.median(left)) if len(left) else float("nan")
    acceleration = np.log(_MIN_ACCELERATION_M_S2 + _acceleration_m_s2(person))
    turned = np.log(_MIN_TURNED + _turned(person))
    lies = float(is_on_floor(person.track))
    evidence = np.array([1.0, _mean(person.correction_m[is_known]), acceleration, pitch_deviation_rad, turned, lies])
    return Reliability(
        expected_error_m=float(np.minimum(np.exp(_WEIGHTS @ evidence), _MAX_EXPECTED_M)),
        misfit_m=misfit,
        left_out_m=left_out_m,
        share_seen=_mean(person.num_joints_seen / OP14.num_joints),
        share_bridged=_mean(person.is_bridged),
        doubts=tuple(doubts),
        farthest_s=float(person.track.times_s[is_known][np.argmax(left)]) if len(left) else float("nan"),
        is_unproven=is_unproven,
        evidence=evidence,
    )


def _judge_place(deviation_m: float, expected_m: float, doubts: tuple[str, ...]) -> PlaceReliability:
    """Judge the place of two people by its deviation and, if known, the expected error of their poses."""
    if not math.isfinite(expected_m):
        return PlaceReliability(deviation_m, doubts)
    evidence = np.array([1.0, np.log(deviation_m * math.sqrt(expected_m))])
    expected = float(np.minimum(np.exp(_PLACE_WEIGHTS @ evidence), _MAX_EXPECTED_PLACE_M))
    return PlaceReliability(expected, doubts, evidence=evidence)


def left_out_misfit_m(database: Database, index: ProjectionIndex, motion: npt.NDArray[np.object_]) -> float:
    """Return the 95th percentile of the misfits of the database's frames when their own motion is left out.

    Frames and yaws are evenly spread, so the result depends only on the database.

    Args:
        database: Database.
        index: Its index.
        motion: Name of the motion of each row (row,), such as its take; rows of one name are left out together.

    Returns:
        Metres; NaN if all rows have one name.  If the nearest rows of a frame are all of its own motion, the distance
        of the farthest of them counts, which is too small rather than too large.
    """
    if len(np.unique(motion.astype(str))) < 2:
        return float("nan")
    rows = evenly_spread(database.num_rows, _NUM_LEFT_OUT)
    yaw = database.num_yaws * np.mod(_GOLDEN * np.arange(len(rows)), 1.0)
    query = database.camera.project(database.turned(rows, yaw))
    nearest_rows = index.search(query, num_neighbours=_NUM_NEIGHBOURS)
    is_other = (nearest_rows.row >= 0) & (motion[np.maximum(nearest_rows.row, 0)] != motion[rows][:, None])
    reached = np.where(np.isfinite(nearest_rows.distance_m), nearest_rows.distance_m, 0.0).max(axis=1)
    nearest = np.where(is_other, nearest_rows.distance_m, np.inf).min(axis=1)
    return float(np.percentile(np.minimum(nearest, reached), LEFT_OUT_PERCENTILE))


def camera_doubt(pitches_rad: Sequence[float], pitch: PitchEstimate) -> tuple[str, ...]:
    """Return a warning if the camera pitch is at the edge of the search or uncertain.

    A level camera is no edge, because few cameras look up at people.
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
    """Tell whether a pitch is at or beyond the edge of those that were tried."""
    if len(pitches_rad) < 2 or pitch.is_given:
        return False
    return pitch.pitch_rad >= max(pitches_rad) or pitch.pitch_rad <= min(*pitches_rad, _LEVEL_RAD)


def _acceleration_m_s2(person: ReconstructedTrack) -> float:
    """Return the mean acceleration of the joints about the mid-hip; 0 for fewer than three frames."""
    step = max(1, round(person.track.rate_hz / _ACCELERATION_HZ))
    poses = (person.positions_m - person.root_m[:, None])[::step]
    if len(poses) < 3:
        return 0.0
    bend = np.linalg.norm(np.diff(poses, n=2, axis=0), axis=-1)
    return float(bend.mean()) * (person.track.rate_hz / step) ** 2


def _turned(person: ReconstructedTrack) -> float:
    """Return the mean turn of the line between the hips out of the image plane, 0 to 1."""
    across = np.diff(person.positions_m[:, _HIPS], axis=1)[:, 0]
    return _mean(np.abs(across[:, 2]) / np.maximum(np.linalg.norm(across, axis=-1), 1e-9))


def _depth_between_m(first: ReconstructedTrack, second: ReconstructedTrack) -> float:
    """Return the mean depth between two people over the frames with both."""
    _, at, there = np.intersect1d(first.track.frames, second.track.frames, return_indices=True)
    return _mean(np.abs(first.root_m[at, 2] - second.root_m[there, 2]))


def _with_interval(error_m: float, parts: tuple[float, float]) -> str:
    if not math.isfinite(error_m):
        return ""
    low, high = (100.0 * error_m * part for part in parts)
    return f"{100.0 * error_m:.0f} cm ({low:.0f} to {high:.0f})"


def _mean(values: npt.ArrayLike) -> float:
    known = np.asarray(values, dtype=np.float64)
    return float(known.mean()) if known.size else float("nan")
