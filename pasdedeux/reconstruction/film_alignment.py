"""Align real film with a captured take of it: people, clocks, and the true camera.

The alignment uses only keypoints and the joints of the take, so errors measured with it are those of the
reconstruction, including its camera and places.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations

import numpy as np

from pasdedeux.arrays import Array, Flags, Integers
from pasdedeux.cameras.pinhole import PinholeCamera
from pasdedeux.errors import InputError
from pasdedeux.people.names import person_name
from pasdedeux.plain_text import counted
from pasdedeux.reconstruction.tracks import Lens, Track

MAX_RESIDUAL = 0.05
"""Largest median distance of keypoints from the take's joints, as a part of people's height in the image: 2.2 to 2.7 %
for five takes and their own motion with noise of 1.8 %, 5.2 to 9.4 % for other motions."""

_RATES = (1.0, 0.5, 2.0, 5 / 6, 6 / 5)
"""Seconds of the take per second of film to try: some headers are wrong by 2, and some state 30 Hz for 25."""
_STEP_S = 0.1
_NUM_TRIED_FRAMES, _NUM_FITTED_FRAMES = 40, 200
_MAX_TRACKS = 4
"""Number of longest tracks among which the people of the take are searched."""
_NUM_REFINED = 3
_MIN_POINTS = 30
_LENS_DEVIATION, _RATE_DEVIATION = 0.35, 0.02
"""Standard deviations of the logarithms of an unknown focal length, and of the rate over the one tried."""
_NOISE = 0.01
"""Error of keypoints, as a part of a person's height; larger errors have less weight."""
_OURS_FROM_CV = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class FilmAlignment:
    """The alignment of film and take.

    Args:
        camera: The camera of the film, in the axes of the take.
        person_ids: Person of the film for each person of the take.
        offset_s: Time of the take at time 0 of the film.
        rate: Seconds of the take per second of film.
        residual: Median distance of keypoints from the joints of the take, as a part of people's height.
    """

    camera: PinholeCamera
    person_ids: tuple[int, ...]
    offset_s: float
    rate: float
    residual: float

    def in_words(self) -> str:
        """Return the alignment in words."""
        people = ", ".join(f"person {name} is {person_name(at)}" for at, name in enumerate(self.person_ids))
        return (
            f"Film and take: {people}; the film's time 0 is {self.offset_s:.3f} s of the take, and a second "
            f"of it {self.rate:.4f} s; keypoints are {100 * self.residual:.1f} % of people's height from its joints, "
            f"before a camera that looks {np.rad2deg(self.camera.pitch_rad):.1f} degrees down."
        )

    def truth_at(self, truth_m: Array, truth_hz: float, times_s: Array) -> Array:
        """Return the take (frame, ...) at times (n,) of the film; NaN outside the take."""
        return _at(truth_m, (self.offset_s + self.rate * times_s) * truth_hz)


def align_film(tracks: Sequence[Track], truth_m: Array, truth_hz: float) -> FilmAlignment:
    """Find the people, clocks and camera that project the joints of the take onto the keypoints.

    Clocks and people are tried on some frames; resection gives the camera of each try (SQPnP, Terzakis and Lourakis
    2020).  The best tries are refined together with camera, focal length (unless known), offset and rate.

    Args:
        tracks: People of the film, possibly more than those of the take.
        truth_m: The take in op14 joints (frame, person, 14, 3), metres, y up.
        truth_hz: Its frames per second.

    Raises:
        InputError: The film has too few people, or shows another motion than the take.
    """
    num_people, duration_s = truth_m.shape[1], (len(truth_m) - 1) / truth_hz
    longest = sorted(tracks, key=lambda track: -int((track.confidence > 0).sum()))[:_MAX_TRACKS]
    if len(longest) < num_people:
        raise InputError(f"the film shows {counted(len(longest), 'person')}, the take has {num_people}")
    times = np.unique(np.concatenate([track.times_s for track in longest]))
    film = _FilmPoints.of(
        longest, times[np.linspace(0, len(times) - 1, min(_NUM_TRIED_FRAMES, len(times))).astype(int)]
    )
    tried = []
    for rate in _RATES:
        overlap_s = 0.5 * min(duration_s, rate * float(np.ptp(times)))
        for offset in np.arange(overlap_s - rate * times[-1], duration_s - overlap_s - rate * times[0], _STEP_S):
            truth = _at(truth_m, (offset + rate * film.times_s) * truth_hz)
            tried += [
                (film.residual(people, truth), people, float(offset), rate)
                for people in permutations(range(len(longest)), num_people)
            ]
    tried.sort()
    whole = _FilmPoints.of(
        longest, times[np.linspace(0, len(times) - 1, min(_NUM_FITTED_FRAMES, len(times))).astype(int)]
    )
    refined = [whole.refined(truth_m, truth_hz, *start[1:]) for start in tried[:_NUM_REFINED] if np.isfinite(start[0])]
    if not refined:
        raise InputError("no clock brings enough joints that the film shows together with the take")
    best = min(refined, key=lambda alignment: alignment.residual)
    if best.residual > MAX_RESIDUAL:
        raise InputError(
            "under no camera and clock do the joints of the take lie on the keypoints (off by "
            f"{100 * best.residual:.0f} % of people's height, allowed {100 * MAX_RESIDUAL:.0f} %): it is another "
            "motion, or its joints are mapped wrongly"
        )
    return best


@dataclass(frozen=True)
class _FilmPoints:
    """Keypoints (frame, track, 14, 2) at some times (frame,), NaN where not seen."""

    keypoints_px: Array
    times_s: Array
    height_px: float
    lens: Lens
    person_ids: tuple[int, ...]

    @classmethod
    def of(cls, tracks: Sequence[Track], times_s: Array) -> _FilmPoints:
        points = np.full((len(times_s), len(tracks), *tracks[0].keypoints_px.shape[1:]), np.nan)
        for number, track in enumerate(tracks):
            at = np.rint((times_s - track.first_time_s) * track.rate_hz).astype(int)
            there = (at >= 0) & (at < len(track.keypoints_px))
            seen = np.where(track.confidence[..., None] > 0, track.keypoints_px, np.nan)
            points[there, number] = seen[at[there]]
        is_seen = np.isfinite(points).all(axis=-1)
        # If nobody is ever seen whole, take the tallest visible part, exceeded in one of ten frames.
        of_anybody, of_whole = np.any(is_seen, axis=2), np.all(is_seen, axis=2)
        shown = points[of_whole if of_whole.any() else of_anybody][..., 1]
        heights = np.nanmax(shown, axis=1) - np.nanmin(shown, axis=1)
        height = float(np.percentile(heights, 50 if of_whole.any() else 90)) if len(heights) else 1.0
        return cls(points, times_s, max(height, 1.0), tracks[0].lens, tuple(track.person_id for track in tracks))

    def _known(self, people: Sequence[int], truth: Array) -> tuple[Array, Array, Flags]:
        points = self.keypoints_px[:, list(people)]
        is_known = np.asarray(np.isfinite(points).all(axis=-1) & np.isfinite(truth).all(axis=-1))
        return points[is_known], truth[is_known], is_known

    def _resect(self, points: Array, joints: Array) -> Array | None:
        """Return rotation vector and translation (6,) of OpenCV's camera; None where there are too few points."""
        import cv2  # here: a quarter of a second that others need not wait for

        if len(points) < _MIN_POINTS:
            return None
        matrix = np.diag([self.lens.focal_px, self.lens.focal_px, 1.0])
        matrix[:2, 2] = self.lens.principal_point_px
        is_found, turn, shift = cv2.solvePnP(joints, points, matrix, None, flags=cv2.SOLVEPNP_SQPNP)
        return np.concatenate([turn.ravel(), shift.ravel()]) if is_found else None

    def _distance(self, camera: Array, log_lens: float, points: Array, joints: Array) -> Array:
        """Return the offset in the image (n, 2) of joints from points, as a part of people's height."""
        from scipy.spatial.transform import Rotation  # here, as everywhere: planning does not need it

        seen = joints @ Rotation.from_rotvec(camera[:3]).as_matrix().T + camera[3:]
        flat = self.lens.focal_px * np.exp(log_lens) * seen[:, :2] / np.maximum(seen[:, 2:], 1e-3)
        return np.asarray((flat + np.array(self.lens.principal_point_px) - points) / self.height_px)

    def residual(self, people: Sequence[int], truth: Array) -> float:
        """Return the median distance under the camera by resection."""
        points, joints, _ = self._known(people, truth)
        camera = self._resect(points, joints)
        if camera is None:
            return float("inf")
        return float(np.median(np.linalg.norm(self._distance(camera, 0.0, points, joints), axis=1)))

    def refined(
        self, truth_m: Array, truth_hz: float, people: Sequence[int], offset_s: float, rate: float
    ) -> FilmAlignment:
        """Return the alignment refined from a try."""
        from scipy.optimize import least_squares
        from scipy.spatial.transform import Rotation

        middle_s, lens_deviation = float(self.times_s.mean()), 1e-4 if self.lens.is_known else _LENS_DEVIATION
        points, joints, is_known = self._known(people, _at(truth_m, (offset_s + rate * self.times_s) * truth_hz))
        camera = self._resect(points, joints)
        assert camera is not None, "it was tried"
        frame_s = np.broadcast_to(self.times_s[:, None, None], is_known.shape)[is_known] - middle_s
        who, joint = (index[is_known] for index in np.indices(is_known.shape)[1:])
        start_s = offset_s + rate * middle_s

        def at(x: Array) -> Array:
            low, high, share = _around(len(truth_m), (start_s + x[7] + rate * np.exp(x[8]) * frame_s) * truth_hz)
            share = share[:, None]
            return np.asarray((1.0 - share) * truth_m[low, who, joint] + share * truth_m[high, who, joint])

        def distances(x: Array) -> Array:
            return self._distance(x[:6], float(x[6]), points, at(x))

        def residuals(x: Array) -> Array:
            priors = np.array([x[6] / lens_deviation, x[8] / _RATE_DEVIATION])
            return np.concatenate([distances(x).ravel() / _NOISE, priors])

        limit = np.array([*[np.inf] * 6, 1.0, 10.0 * _STEP_S, 3.0 * _RATE_DEVIATION])
        start = np.concatenate([camera, np.zeros(3)])
        x = least_squares(residuals, start, bounds=(-limit, limit), loss="soft_l1", x_scale="jac", max_nfev=50).x
        turn = _OURS_FROM_CV @ Rotation.from_rotvec(x[:3]).as_matrix()
        aligned = PinholeCamera(
            focal_px=self.lens.focal_px * float(np.exp(x[6])),
            principal_point_px=np.array(self.lens.principal_point_px),
            camera_from_world_rotmat=turn,
            position_m=-turn.T @ _OURS_FROM_CV @ x[3:6],
        )
        own_rate = rate * float(np.exp(x[8]))
        median = float(np.median(np.linalg.norm(distances(x), axis=1)))
        names = tuple(self.person_ids[person] for person in people)
        return FilmAlignment(aligned, names, start_s + float(x[7]) - own_rate * middle_s, own_rate, median)


def _at(motion: Array, frames: Array) -> Array:
    """Return a motion (frame, ...) at frames (n,) that may lie between two; NaN outside of it."""
    low, high, share = _around(len(motion), frames)
    share = share.reshape(-1, *[1] * (motion.ndim - 1))
    is_inside = np.abs(frames - np.clip(frames, 0.0, len(motion) - 1.0)) < 0.5
    between = (1.0 - share) * motion[low] + share * motion[high]
    return np.asarray(np.where(is_inside.reshape(share.shape), between, np.nan))


def _around(num_frames: int, frames: Array) -> tuple[Integers, Integers, Array]:
    """Return the two frames of a motion around each of some that may lie between two, and the share of the second."""
    inside = np.clip(frames, 0.0, num_frames - 1.0)
    low = np.minimum(inside.astype(int), max(num_frames - 2, 0))
    return low, np.minimum(low + 1, num_frames - 1), inside - low
