"""How good a reconstruction is, without ground truth: for each person a figure, and pass, warn or fail in words.

The figure is the error to expect.  It comes from how far the fit moved the retrieved poses: where the database holds
the motion, the image only touches them up; where it does not, or the camera is not where it was taken to be, they have
to give way.  What is left of the match's distance when the image's noise is taken off is compared with that of the
database's own motions, each matched against all others: farther than those, the database lacks the motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pasdedeux.projections.database import Database
from pasdedeux.projections.search import ProjectionIndex
from pasdedeux.reconstruction.pitch import PitchEstimate
from pasdedeux.reconstruction.reconstruct import MEAN_OF_RAYLEIGH, Reconstruction
from pasdedeux.skeletons import OP14
from pasdedeux.verdict import Level, Verdict

ERROR_WITHOUT_CORRECTION_M = 0.04
ERROR_PER_CORRECTION = 0.6
"""Mean error of a joint over how far the fit moved it: least squares of the relative error on 124 virtual clips of nine
takes (salsa, duets, single people, contact) under four databases, noise 1 to 8 px and up to a quarter of the joints
hidden.  Measured anew with camera, sizes and places as one estimate, on 218 people of 109 such clips: 120 of them, of
eleven other takes, are over or under 10 cm, with an AUC of 0.81, median 10.2 cm expected and 10.1 found; least
squares on the other 98 would say 0.032 m and 0.64."""

DOUBTFUL_ERROR_M, BAD_ERROR_M = 0.10, 0.20
POOR_SHARE_SEEN, USELESS_SHARE_SEEN = 0.7, 0.4
"""Share of the 14 joints that are seen: below the first a person is doubted, below the second useless."""
DOUBTFUL_PITCH_RAD = float(np.deg2rad(5.0))
"""A pitch of a larger standard deviation is doubted: it leans people and tilts the floor."""
MAX_BRIDGED = 0.2
"""A motion of which more is interpolated deserves a warning."""
LEFT_OUT_PERCENTILE = 95.0
"""Of the database's left-out frames have a misfit no larger than what is still taken for motion that it holds."""

_LEVEL_RAD = float(np.deg2rad(-1.0))
"""A camera that looks up by less is as good as level."""
_NUM_LEFT_OUT, _NUM_NEIGHBOURS = 128, 1000


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
    """

    expected_error_m: float
    misfit_m: float
    left_out_m: float
    share_seen: float
    share_bridged: float
    doubts: tuple[str, ...] = ()

    @property
    def is_lacking(self) -> bool:
        """Tell whether the database lacks the motion."""
        return self.misfit_m > self.left_out_m

    @property
    def verdict(self) -> Verdict:
        """Pass, warn or fail, and why."""
        reasons = []
        if self.expected_error_m > DOUBTFUL_ERROR_M:
            reasons.append("the fit had to move the poses of the database far")
        if self.is_lacking:
            reasons.append(
                f"the database lacks this motion: {100 * self.misfit_m:.1f} cm from the nearest projections, its own "
                f"left-out clips at most {100 * self.left_out_m:.1f}"
            )
        if self.share_seen < POOR_SHARE_SEEN:
            reasons.append(f"{self.share_seen:.0%} of the joints are seen")
        if self.share_bridged > MAX_BRIDGED:
            reasons.append(f"{self.share_bridged:.0%} of the frames show too little and are interpolated")
        is_bad = self.expected_error_m > BAD_ERROR_M or self.share_seen < USELESS_SHARE_SEEN
        reasons += self.doubts
        level = Level.FAIL if is_bad else Level.WARN if reasons else Level.PASS
        figure = ("expected error", self.expected_error_m, "m")
        return Verdict(level, "; ".join(reasons), *figure, thing="people")


def judge_person(found: Reconstruction, left_out_m: float = float("nan"), *, doubts: Sequence[str] = ()) -> Reliability:
    """Judge a person's reconstruction by method `fit`; of another nobody knows what error to expect.

    Args:
        found: Reconstruction.
        left_out_m: Misfit that the database's own motions have at most, from `left_out_misfit_m`.
        doubts: Further reasons for a warning.
    """
    is_known = ~found.is_bridged & np.isfinite(found.score_m)
    correction = found.correction_m[is_known]
    noise = MEAN_OF_RAYLEIGH * found.noise_m
    misfit = np.sqrt(np.maximum(found.score_m[is_known] ** 2 - noise**2, 0.0))
    return Reliability(
        expected_error_m=ERROR_WITHOUT_CORRECTION_M + ERROR_PER_CORRECTION * _mean(correction),
        misfit_m=float(np.median(misfit)) if len(misfit) else float("nan"),
        left_out_m=left_out_m,
        share_seen=_mean(found.num_joints_seen / OP14.num_joints),
        share_bridged=_mean(found.is_bridged),
        doubts=tuple(doubts),
    )


def left_out_misfit_m(
    database: Database, index: ProjectionIndex, motion: npt.NDArray[np.object_], rng: np.random.Generator
) -> float:
    """Return the misfit that frames of the database have at most when their own motion is left out, 95 % of them.

    Args:
        database: Database.
        index: Its index.
        motion: Name of the motion of each row, (row,), such as its take: rows of one name are left out together.
        rng: Draws frames and yaws.

    Returns:
        Metres; NaN where all rows have one name.  A frame whose nearest rows are all of its own motion counts with
        the distance of the farthest of those, which is too small rather than too large.
    """
    if len(np.unique(motion.astype(str))) < 2:
        return float("nan")
    rows = rng.integers(0, database.num_rows, _NUM_LEFT_OUT)
    yaw = rng.uniform(0.0, database.num_yaws, _NUM_LEFT_OUT)
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
    if len(pitches_rad) < 2:
        return ()
    if pitch.pitch_rad >= max(pitches_rad) or pitch.pitch_rad <= min(*pitches_rad, _LEVEL_RAD):
        return (f"{pitch.in_words()}, at the edge of what was tried: it may be more, or wrong",)
    return (f"{pitch.in_words()}",) if pitch.deviation_rad > DOUBTFUL_PITCH_RAD else ()


def _mean(values: npt.ArrayLike) -> float:
    found = np.asarray(values, dtype=np.float64)
    return float(found.mean()) if found.size else float("nan")
