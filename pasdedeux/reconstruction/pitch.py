"""The pitch of a sequence's camera, and the floor on which its people stand."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.errors import InputError
from pasdedeux.projections.database import DatabaseCamera
from pasdedeux.projections.retarget import mid_hip
from pasdedeux.reconstruction.lying import is_on_floor, searchers_for, stands
from pasdedeux.reconstruction.matching import Method, ReconstructionOptions, Searcher, match_track
from pasdedeux.reconstruction.reconstruct import ReconstructedTrack, reconstruct_track
from pasdedeux.reconstruction.tracks import Track
from pasdedeux.skeletons import OP14

_STRIDE, _FEW_FRAMES = 5, 8
"""Stride over the frames that are judged, and the number of frames below which a short video is not thinned."""
_FLOOR_WEIGHT = 0.05
"""Cost of a metre between standing feet and the floor; a metre of misfit costs 1."""
_MAX_FLOOR_M = 0.1
"""Largest deviation from the floor that counts: the distance of people who come very near is badly known."""

_LENS_FACTORS = (0.8, 1.0, 1.25, 1.56)
"""Focal lengths to try, over the assumed one: from phones to short telephoto lenses."""

_LEVEL_RAD, _STEEP_RAD = 0.0, float(np.deg2rad(30.0))
_LOOKS_UP_RAD, _LOOKS_DOWN_RAD = float(np.deg2rad(5.0)), float(np.deg2rad(10.0))
"""Prior of the pitch: uniform from level to 30 degrees down, with these standard deviations beyond either end."""
_FROM_BELOW = 0.05
"""Smallest density of a camera that looks up, as from before a stage, over that of a level camera."""
_GRID_RAD, _BEYOND_RAD = float(np.deg2rad(0.5)), float(np.deg2rad(5.0))
"""Step between compared pitches, and how far they reach below the first pitch tried and above the last."""

_LINES = tuple(OP14.indices([f"left_{name}", f"right_{name}"]) for name in ("hip", "shoulder"))
_LINE_DEVIATION_M = np.array([0.02, 0.05])
"""Standard deviation of the height of one end over the other, for the lines between the hips and the shoulders."""
_SLOPE_DEVIATION = np.deg2rad([2.0, 4.0])
"""Standard deviation of the slopes of both lines that remains however long they are seen."""
_ALIKE_S = 0.5
"""Errors of frames nearer in time than this are alike."""
_MISFITS_PER_S, _MAX_MISFITS = 6.0, 25.0
"""Number of independent misfits per second, and largest number: a pose that a database lacks stays wrong."""
_COMMON_MISFIT_M = 0.02
"""Misfit of any pose; smaller ones carry no information."""

_MIN_STANDING = 3
"""Smallest number of frames in which a person must stand to be judged."""

_ANKLES = OP14.indices(["left_ankle", "right_ankle"])


@dataclass(frozen=True)
class PitchEstimate:
    """The pitch of a sequence's camera.

    Args:
        pitch_rad: The pitch.
        deviation_rad: Its standard deviation; 0 if it was stated.
        is_guess: Whether nobody was seen standing, so that it is little more than the prior.
    """

    pitch_rad: float
    deviation_rad: float = 0.0
    is_guess: bool = False

    @property
    def is_given(self) -> bool:
        """Whether the pitch was stated, not estimated."""
        return self.deviation_rad == 0.0

    def in_words(self) -> str:
        """Return the pitch in words."""
        deviation = "" if self.is_given else f" +- {np.rad2deg(self.deviation_rad):.1f}"
        return f"camera pitch {np.rad2deg(self.pitch_rad):.3g}{deviation} degrees"


def choose_pitch(searchers: Iterable[Searcher], tracks: Sequence[Track]) -> PitchEstimate:
    """Return the pitch at which the searchers (one per camera pitch) fit the tracks of a sequence best.

    The pitch does not change within a sequence.  Every fifth frame counts if the person stands: back upright in the
    image, legs stretched, feet below.  Crouching or carried people are excluded.  People on the floor are also matched
    to lying poses, and only the mean distance of their matches counts.  If nobody stands, the estimate is a guess.

    The log likelihood sums over people

    - the mean distance of the matches, plus `_FLOOR_WEIGHT` times the median deviation of the lower ankle from its
      median height, up to a bound.  Under a wrong pitch or focal length, a person who comes nearer on a flat floor
      seems to sink or climb.  If the focal length is unknown, the best of several counts.  Unseen ankles are excluded;
    - the slopes of the lines between hips and between shoulders, which are level even if the person leans: before a
      camera that looks down, the nearer end is lower in the image by the sine of the pitch.  The matched pose shows how
      much nearer it is.

    Both are interpolated between the pitches of the searchers, and a little beyond.  The prior prefers cameras between
    level and 30 degrees down; its penalty is bounded for cameras that look up.  The result is the mean of the posterior
    and its standard deviation, which includes the spread when each person, or half of the video, is left out.
    """
    stride = max(1, min(_STRIDE, max(len(track.keypoints_px) for track in tracks) // _FEW_FRAMES))
    thinned = [track.every(stride) for track in tracks]
    pitches, judged = [], []
    for searcher in searchers:
        pitches.append(searcher.database.camera.pitch_rad)
        matched = zip(searchers_for(searcher, thinned), thinned, strict=True)
        judged.append([evidence for ready, track in matched if (evidence := _judge(ready, track)) is not None])
    tried = np.array(pitches)
    if len(tried) < 2:
        return PitchEstimate(pitches[0])
    grid = np.arange(tried.min() - _BEYOND_RAD, tried.max() + _BEYOND_RAD + 1e-9, _GRID_RAD)
    everybody = [person for person in zip(*judged, strict=False) if person[0].num_counted >= _MIN_STANDING]
    halves = [[tuple(shown.half(part) for shown in person) for person in everybody] for part in (0, 1)]
    others = [everybody[:number] + everybody[number + 1 :] for number in range(len(everybody))]
    pitch, deviation = _posterior(tried, grid, everybody)
    parts = (*halves, *(others if len(others) > 1 else ()))
    spread = np.std([_posterior(tried, grid, part)[0] for part in parts]) if everybody else 0.0
    is_guess = all(stands(track).sum() < _MIN_STANDING for track in thinned)
    return PitchEstimate(pitch, float(np.hypot(deviation, spread)), is_guess)


def _posterior(tried: Array, grid: Array, people: Sequence[Sequence[_Evidence]]) -> tuple[float, float]:
    """Return mean and standard deviation of the pitch from the evidence of people under each pitch tried."""
    from scipy.interpolate import CubicSpline  # here: 0.2 s that planning does not need

    looks_up, looks_down = np.minimum(grid - _LEVEL_RAD, 0.0), np.maximum(grid - _STEEP_RAD, 0.0)
    score = np.log(np.exp(-0.5 * (looks_up / _LOOKS_UP_RAD) ** 2) + _FROM_BELOW)
    score -= 0.5 * (looks_down / _LOOKS_DOWN_RAD) ** 2
    order = np.argsort(tried)
    for evidence in people:
        # Distances grow in proportion to the error of the pitch, so their squares follow a parabola.
        square = np.array([shown.cost() ** 2 for shown in evidence])[order]
        between = np.maximum(CubicSpline(tried[order], square)(grid), 0.8 * square.min())
        score -= 0.5 * evidence[0].num_misfits * np.log(between + _COMMON_MISFIT_M**2)
        for lines in np.moveaxis(np.array([shown.slopes() for shown in evidence])[order], -1, 0):
            slope, variance = (np.interp(grid, tried[order], values) for values in lines.T)
            score -= 0.5 * (np.sin(grid) - slope) ** 2 / variance
    share = np.exp(score - score.max())
    share /= share.sum()
    mean = float(share @ grid)
    return mean, float(np.sqrt(share @ (grid - mean) ** 2))


def floor_offset(tracks: Sequence[ReconstructedTrack], camera: DatabaseCamera) -> Array:
    """Return the origin (3,) of the common frame of a sequence's people: lowest ankle at 0, start at x = z = 0.

    Subtract it from positions.  Camera axes; heights are along the upright axis.  The lowest ankle of all people is
    assumed to stand on the floor.
    """
    upright = camera.camera_from_upright_rotmat
    people = [track.positions_m @ upright for track in tracks]  # camera axes to upright axes: the transpose
    floor = min(float(np.min(positions[:, _ANKLES, 1])) for positions in people)
    start = np.mean([mid_hip(positions[0]) for positions in people], axis=0)
    return np.asarray(upright @ np.array([start[0], floor, start[2]]))


@dataclass(frozen=True)
class _Evidence:
    """Evidence of a track under one pitch.

    Args:
        rate_hz: Frames per second.
        distance_m: Distance of the match (frame,), NaN where interpolated, and where a person off the floor
            does not stand.
        height_m: Height of the lower ankle under each lens (lens, frame), NaN if it is not seen.
        nearer_m: How much nearer the left end of each line is by the match (frame, line), upright axes; NaN if it is
            not seen or the person does not stand.
        higher_m: How much higher the left end is in the image, without the effect of perspective.
    """

    rate_hz: float
    distance_m: Array
    height_m: Array
    nearer_m: Array
    higher_m: Array

    @property
    def num_counted(self) -> int:
        """Number of frames that count."""
        return int(np.isfinite(self.distance_m).sum())

    @property
    def num_misfits(self) -> float:
        """Number of distances with independent errors."""
        return min(_MAX_MISFITS, _MISFITS_PER_S * self.num_counted / self.rate_hz)

    def cost(self) -> float:
        """Return the mean distance plus the weighted deviation of feet from the floor, metres."""
        is_known = np.isfinite(self.distance_m)
        if not is_known.any():
            return 0.0
        return float(self.distance_m[is_known].mean()) + _FLOOR_WEIGHT * min(self._off_m(), _MAX_FLOOR_M)

    def slopes(self) -> tuple[Array, Array]:
        """Return how much lower the nearer end of each line is, and the variance of that (line,)."""
        alike = max(1.0, _ALIKE_S * self.rate_hz)
        length = np.nansum(self.nearer_m**2, axis=0)
        slope = -np.nansum(self.nearer_m * self.higher_m, axis=0) / np.maximum(length, 1e-9)
        return slope, _LINE_DEVIATION_M**2 * alike / np.maximum(length, 1e-9) + _SLOPE_DEVIATION**2

    def _off_m(self) -> float:
        """Return the median deviation of the ankle from its median height under the best lens; 0 if never seen."""
        is_seen = np.isfinite(self.height_m)
        heights = [height[seen] for height, seen in zip(self.height_m, is_seen, strict=True) if seen.any()]
        return min((float(np.median(np.abs(height - np.median(height)))) for height in heights), default=0.0)

    def half(self, part: int) -> _Evidence:
        """Return the evidence of the first or the second half of the video."""
        count = len(self.distance_m)
        is_in_part = np.arange(count) * 2 // count == part
        return replace(
            self,
            distance_m=self.distance_m[is_in_part],
            height_m=self.height_m[:, is_in_part],
            nearer_m=self.nearer_m[is_in_part],
            higher_m=self.higher_m[is_in_part],
        )


def _judge(searcher: Searcher, track: Track) -> _Evidence | None:
    """Match a track under one pitch; return None if too little is seen for a search."""
    try:
        matches = match_track(searcher, track, ReconstructionOptions(num_candidates=1))
    except InputError:
        return None
    nearest = reconstruct_track(searcher, track, Method.NEAREST, matches=matches)
    upright = searcher.database.camera.camera_from_upright_rotmat
    is_seen = (track.confidence[:, _ANKLES] > 0) & ~nearest.is_bridged[:, None]
    heights = []
    for factor in (1.0,) if track.lens.is_known else _LENS_FACTORS:
        # With another focal length, distances are multiplied by the same factor.
        farther = nearest.root_m * [0.0, 0.0, factor - 1.0]
        height = (nearest.positions_m[:, _ANKLES] + farther[:, None]) @ upright[:, 1]
        lower = np.argmin(height, axis=1)[:, None]
        seen = np.take_along_axis(is_seen, lower, axis=1)
        heights.append(np.where(seen, np.take_along_axis(height, lower, axis=1), np.nan)[:, 0])
    is_standing = ~nearest.is_bridged & stands(track)
    pose = (
        searcher.database.turned(np.maximum(matches.neighbours.row[:, 0], 0), matches.yaw_steps[:, 0])
        * matches.proportions[:, None]
    )
    away = matches.placement.metres_per_pixel * track.lens.focal_px
    nearer, higher = [], []
    ray = -np.arcsin(matches.towards_camera[:, 1])
    ray -= ray[is_standing].mean() if is_standing.any() else 0.0
    for left, right in _LINES:
        nearer.append(np.where(is_standing, pose[:, left, 2] - pose[:, right, 2], np.nan))
        ends = matches.query_m[:, [left, right], 1]
        # A camera looks down less steeply at shoulders than at hips, and at people far away.
        level = np.arctan(ends.mean(axis=1) / away) + ray
        lower = np.sin(level) * np.cos(searcher.database.camera.pitch_rad)
        higher.append(ends[:, 0] - ends[:, 1] - lower * nearer[-1])
    shown = np.stack(nearer, axis=1), np.stack(higher, axis=1)
    nearer_m, higher_m = (np.where(np.isfinite(shown[1]), values, np.nan) for values in shown)
    counts = ~nearest.is_bridged if is_on_floor(track) else is_standing
    distance = np.where(counts, matches.neighbours.distance_m[:, 0], np.nan)
    return _Evidence(track.rate_hz, distance, np.where(is_standing, np.stack(heights), np.nan), nearer_m, higher_m)
