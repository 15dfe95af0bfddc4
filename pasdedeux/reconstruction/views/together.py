"""Reconstruct the people of a take from several cameras: each alone, then clocks, cameras and poses together."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import NamedTuple

import numpy as np

from pasdedeux.arrays import Array, interpolate
from pasdedeux.cameras.pinhole import PinholeCamera
from pasdedeux.errors import InputError
from pasdedeux.formats.poses2d.calibration import CalibratedCamera
from pasdedeux.kinematics.forward import bone_lengths
from pasdedeux.kinematics.rotations import rotmat_from_unitquat, unitquat_from_rotvec, yaw_rotmat
from pasdedeux.plausibility.capsules import body_height_m
from pasdedeux.reconstruction.matching import MIN_JOINTS
from pasdedeux.reconstruction.people import ReconstructedPeople, SequenceOptions, place_people
from pasdedeux.reconstruction.pitch import PitchEstimate
from pasdedeux.reconstruction.reconstruct import ReconstructedTrack
from pasdedeux.reconstruction.reliability import Judged, PlaceReliability, Reliability
from pasdedeux.reconstruction.sequence import SearchedDatabase, StatedCamera, reconstruct_sequence
from pasdedeux.reconstruction.terms.placed import SeenPerson, up_axis
from pasdedeux.reconstruction.terms.prior import KNOWN_DEVIATION, STATURE_DEVIATION
from pasdedeux.reconstruction.tracks import Lens, Track
from pasdedeux.reconstruction.views.calibration import View, calibrate, lengths_of, meet
from pasdedeux.reconstruction.views.cameras import SeenBy, seen_alone
from pasdedeux.reconstruction.views.clocks import Rising, SameTake, match_cameras
from pasdedeux.reconstruction.views.fit import fit_person
from pasdedeux.skeletons import OP14

_NUM_PASSES = 4
"""Number of calibrations; each uses keypoints at the clocks of the one before."""
_SPEED_S = 0.1
"""Speeds of keypoints are taken over this time before and after: between neighbouring frames, noise dominates."""
_BAD_M, _BAD_CALIBRATED_M, _DOUBTFUL_M = 0.15, 0.06, 0.04
"""Largest distances of joints from their rays: beyond the first (the second with calibration) they are refused, beyond
the third there is a warning.  Keypoints with noise of 2 px give 1 cm, and 8 cm if calibrated cameras are exchanged."""
_BAD_BONES, _DOUBTFUL_BONES = 0.18, 0.1
"""The same for the change of bone lengths where rays meet, upper quartile: 0.05 to 0.07 for duets and salsa with 2 px
of noise, 0.12 to 0.14 with 5 px; 0.10 to 0.16 for cameras 7, 15 and 160 degrees apart, with errors of poses of 7 to 12
cm; 0.08 to 0.21 if one camera shows another duet."""
_MEAN_OVER_DEVIATION = float(np.sqrt(2.0 / np.pi))
"""Mean size of a normal error over its standard deviation."""
_ONE_SIDE_RAD = float(np.deg2rad(4.0))
"""Smallest angle, seen from the people, between different cameras."""
_STATURES_M = 0.6, 2.6
"""Shortest and tallest people."""
_GIVEN_PITCH_RAD = 0.01
"""Standard deviation of a pitch that is given."""


class Moments(NamedTuple):
    """Keypoints of people (frame, person, 14): pixels, velocities and confidence, see `View`."""

    px: Array
    speed_px_s: Array
    confidence: Array


@dataclass(frozen=True)
class SeenTogether:
    """A take seen by several cameras.

    Args:
        people: The people before the first camera.
        views: All cameras, in axes of the first.
        names: Their names.
        rates_hz: Their frames per second.
        first_times_s: Times of their frames 0, each by its own clock.
        off_m: Median distance of joints from their rays.
        bones_vary: Relative change of bone lengths where rays meet, upper quartile.
        is_scale_known: Whether a stature is stated, or the cameras are calibrated.
        left_out: Messages about people of other cameras who match nobody of the first.
    """

    people: ReconstructedPeople
    views: tuple[View, ...]
    names: tuple[str, ...]
    rates_hz: tuple[float, ...]
    first_times_s: tuple[float, ...]
    off_m: float
    bones_vary: float
    is_scale_known: bool
    left_out: tuple[str, ...] = ()

    @property
    def judged(self) -> Judged:
        """Verdicts; expected errors combine the distances from rays with the error of the scale."""
        scale = KNOWN_DEVIATION if self.is_scale_known else STATURE_DEVIATION * _MEAN_OVER_DEVIATION
        doubts = [f"the cameras differ by {100 * self.off_m:.0f} cm"] if self.off_m > _DOUBTFUL_M else []
        if self.bones_vary > _DOUBTFUL_BONES:
            doubts.append(
                f"lengths of bones change by {self.bones_vary:.0%}, as if the cameras stood too close together or "
                "opposite each other, keypoints were inaccurate, or the takes were not the same"
            )
        people, places = {}, {}
        tracks = self.people.methods[-1].people
        for number, person in enumerate(tracks):
            shown = np.any([view.confidence[:, number] > 0 for view in self.views], axis=0)
            reach_m = np.linalg.norm(person.positions_m - person.root_m[:, None], axis=-1).mean()
            people[person.person_id] = Reliability(
                expected_error_m=float(np.hypot(self.off_m, scale * reach_m)),
                misfit_m=self.off_m,
                left_out_m=float("nan"),
                share_seen=float(shown[shown.any(axis=1)].mean()),
                share_bridged=float(person.is_bridged.mean()),
                doubts=tuple(doubts),
            )
        for first, second in combinations(tracks, 2):
            both, at, other = np.intersect1d(first.track.frames, second.track.frames, return_indices=True)
            if len(both):
                apart_m = np.linalg.norm(first.root_m[at] - second.root_m[other], axis=-1).mean()
                expected_m = float(np.hypot(self.off_m, scale * apart_m))
                places[first.person_id, second.person_id] = PlaceReliability(expected_m, tuple(doubts))
        return Judged(people, places)

    @property
    def cameras(self) -> list[SeenBy]:
        """The cameras in the frame of the motions, starting with the first."""
        first, people = seen_alone(self.people, self.names[0]), self.people.methods[-1].people
        middle_m = np.mean(np.concatenate([person.root_m for person in people]), axis=0)
        cameras = list[SeenBy]()
        for name, view, rate_hz, first_time_s in zip(
            self.names, self.views, self.rates_hz, self.first_times_s, strict=True
        ):
            x, y = view.lens.principal_point_px
            placed = PinholeCamera(
                focal_px=view.lens.focal_px,
                principal_point_px=np.array([x, y]),
                camera_from_world_rotmat=view.rotmat @ first.camera.camera_from_world_rotmat,
                position_m=first.camera.position_m + view.position_m @ first.camera.camera_from_world_rotmat,
                image_size_px=(max(round(2.0 * x), 1), max(round(2.0 * y), 1)),
            )
            angle_rad = _angle_rad(self.views[0], view, middle_m) if cameras else 0.0
            cameras.append(
                SeenBy(name, placed, view.px, rate_hz, first_time_s - view.offset_s, view.offset_s, angle_rad)
            )
        return cameras


def reconstruct_views(
    cameras: Sequence[Sequence[Track]],
    database: SearchedDatabase,
    stated: StatedCamera | None = None,
    options: SequenceOptions | None = None,
    *,
    names: Sequence[str] = (),
    calibration: Sequence[CalibratedCamera] = (),
    on_camera: Callable[[], None] = lambda: None,
) -> SeenTogether:
    """Reconstruct the people of a take seen by several cameras, in the frames of the first camera.

    Args:
        cameras: Tracks of people by camera, at least two cameras; numbers of people may differ between them.
        database: Poses of other takes.
        stated: Stated facts about the first camera.
        options: Clean-up, and statures by person ids of the first camera.
        names: Names of the cameras; by default their numbers from 1 on.
        calibration: The cameras, if given, in any world in metres; else they are estimated from the people.
        on_camera: Called after each camera is reconstructed alone.

    Raises:
        InputError: Before a camera nobody can be reconstructed, the cameras do not show the same people, they do not
            agree, or their number is not that of the calibration.
    """
    options = options or SequenceOptions()
    names = tuple(names or (str(number + 1) for number in range(len(cameras))))
    if calibration and len(calibration) != len(cameras):
        raise InputError(f"the calibration has {len(calibration)} cameras, and {len(cameras)} are given")
    alone = []
    for number, (name, tracks) in enumerate(zip(names, cameras, strict=True)):
        if calibration:
            tracks = [_calibrated(track, calibration[number]) for track in tracks]
        people = reconstruct_sequence(
            tracks,
            database,
            stated if number == 0 else None,
            replace(options, has_clean_up=False, statures_m={} if number else options.statures_m),
        ).people
        if not people.methods:
            raise InputError(f"camera {name}: {next(iter(people.skipped.values()), 'it shows nobody')}")
        alone.append(people)
        on_camera()
    tracks = [people.methods[-1].people[0].track for people in alone]
    same = _match(names, alone, tracks[0].rate_hz)
    person_ids = sorted({person_id for take in same for person_id in take.person_ids.values()})
    first_seen = [_of(alone[0], person_id) for person_id in person_ids]
    seen = [first_seen, *(_in_order(people, take, person_ids) for people, take in zip(alone[1:], same, strict=True))]
    times_s = _times(first_seen)
    statures_m = np.array([_stature_m(column, options) for column in zip(*seen, strict=True)])
    views = _first_views(alone, seen, [0.0, *(take.offset_s for take in same)], times_s, calibration)
    _check_angles(names, views, first_seen)
    is_stated = np.isin(person_ids, list(options.statures_m))
    for _ in range(_NUM_PASSES):
        views = calibrate(views, statures_m, tracks[0].rate_hz, is_stated=is_stated)
        views = [
            replace(view, **_moments(shown, times_s + view.offset_s)._asdict())
            for view, shown in zip(views, seen, strict=True)
        ]
    _check_angles(names, views, first_seen)
    if calibration:
        _check_sizes(views)
    fitted, off_m = _fit_people(views, first_seen, times_s, tracks[0].rate_hz)
    bones_vary = float(np.nanpercentile(np.abs(np.log(lengths_of(meet(views))[0])), 75.0))
    if off_m > (_BAD_CALIBRATED_M if calibration else _BAD_M) or bones_vary > _BAD_BONES:
        order = ", or the calibration is of other cameras or in another order" if calibration else ""
        raise InputError(
            f"cameras {', '.join(names)} do not agree: joints are {100 * off_m:.0f} cm (median) from where each sees "
            f"them, and lengths of bones change by {bones_vary:.0%}; they do not show the same take{order}"
        )
    lens_factor = views[0].lens.focal_px / first_seen[0].track.lens.focal_px
    placed = place_people(alone[0], fitted, _up(alone, views), lens_factor, database.poses, options)
    return SeenTogether(
        placed,
        tuple(views),
        names,
        tuple(track.rate_hz for track in tracks),
        tuple(track.first_time_s - track.first_frame / track.rate_hz for track in tracks),
        off_m,
        bones_vary,
        is_scale_known=bool(calibration) or bool(is_stated.any()),
        left_out=tuple(
            f"camera {name}: person {other.person_id} was left out: matches nobody reconstructed from camera {names[0]}"
            for name, people, take in zip(names[1:], alone[1:], same, strict=True)
            for other in people.methods[-1].people
            if other.person_id not in take.person_ids
        ),
    )


def _angle_rad(first: View, other: View, middle_m: Array) -> float:
    """Return the angle at a point (3,) between the rays to two cameras; 0 if a camera is at the point."""
    a, b = first.position_m - middle_m, other.position_m - middle_m
    cosine = a @ b / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-12) if a.any() and b.any() else 1.0
    return float(np.arccos(np.clip(cosine, -1.0, 1.0)))


def _check_angles(names: Sequence[str], views: Sequence[View], people: Sequence[ReconstructedTrack]) -> None:
    """Refuse cameras that all see the people from one side.

    Raises:
        InputError: The largest angle between them is too small.
    """
    middle_m = np.mean(np.concatenate([person.root_m for person in people]), axis=0)
    most_rad = max(_angle_rad(first, other, middle_m) for first, other in combinations(views, 2))
    if most_rad < _ONE_SIDE_RAD:
        raise InputError(
            f"cameras {', '.join(names)} see the people from one side ({np.rad2deg(most_rad):.0f} degrees apart), so "
            "that they tell no more than one; name files of different cameras"
        )


def _check_sizes(views: Sequence[View]) -> None:
    """Refuse a calibration by which people are too small or too tall.

    Raises:
        InputError: A stature is not plausible.
    """
    statures_m = body_height_m(OP14, lengths_of(meet(views))[1])
    odd_m = statures_m[(statures_m < _STATURES_M[0]) | (statures_m > _STATURES_M[1])]
    if len(odd_m):
        raise InputError(
            f"somebody would be {odd_m[0]:.2g} m tall by the calibration; its translations must be in metres or "
            "millimetres, and its cameras those of the files"
        )


def _match(names: Sequence[str], alone: Sequence[ReconstructedPeople], rate_hz: float) -> list[SameTake]:
    """Return the match of each other camera with the first.

    Raises:
        InputError: They do not show the same people at the same time.
    """
    rising, same = [_rising(people, rate_hz) for people in alone], []
    for name, other in zip(names[1:], rising[1:], strict=True):
        try:
            same.append(match_cameras(rising[0], other, rate_hz))
        except InputError as error:
            raise InputError(f"cameras {names[0]} and {name}: {error}") from None
    return same


def _in_order(people: ReconstructedPeople, take: SameTake, names: Sequence[int]) -> Sequence[ReconstructedTrack | None]:
    """Return the tracks by one camera of people with these ids of the first camera; None where it does not see one."""
    theirs = {name: other for other, name in take.person_ids.items()}
    return [_of(people, theirs[name]) if name in theirs else None for name in names]


def _first_views(
    alone: Sequence[ReconstructedPeople],
    seen: Sequence[Sequence[ReconstructedTrack | None]],
    offsets_s: Sequence[float],
    times_s: Array,
    calibration: Sequence[CalibratedCamera],
) -> list[View]:
    """Return the initial cameras: as given, else by each camera's own reconstruction of the people."""
    views = []
    for number, (people, shown, offset_s) in enumerate(zip(alone, seen, offsets_s, strict=True)):
        rotmat, position_m = np.eye(3), np.zeros(3)
        if number and calibration:
            (first, place), (other, other_place) = (_pose(calibration[at]) for at in (0, number))
            rotmat, position_m = other @ first.T, first @ (other_place - place)
        elif number:
            rotmat, position_m = _placed(alone[0], people, seen[0], shown, offset_s)
        lens = next(person.track.lens for person in shown if person is not None)
        views.append(View(lens, rotmat, position_m, offset_s, *_moments(shown, times_s + offset_s), bool(calibration)))
    return views


def _fit_people(
    views: Sequence[View], people: Sequence[ReconstructedTrack], times_s: Array, rate_hz: float
) -> tuple[list[ReconstructedTrack], float]:
    """Return the people of the first camera fitted to all views, and the distance of joints from their rays, metres."""
    lengths_m = lengths_of(meet(views))[1]
    fitted, off_m = [], []
    for number, person in enumerate(people):
        frames = np.searchsorted(times_s, person.track.times_s - 1e-6)
        shown = [view.chosen(frames) for view in views]
        lengths = np.where(lengths_m[number] > 0, lengths_m[number], bone_lengths(OP14, person.positions_m[:1])[0])
        positions_m, person_off_m = fit_person(shown, number, person.positions_m, lengths, rate_hz)
        is_seen = np.any([(view.confidence[:, number] > 0).sum(axis=1) >= MIN_JOINTS for view in shown], axis=0)
        fitted.append(replace(person.posed(positions_m), is_bridged=~is_seen))
        off_m.append(person_off_m)
    return fitted, float(np.mean(off_m))


def _calibrated(track: Track, camera: CalibratedCamera) -> Track:
    """Return a track with undistorted keypoints and the calibrated lens."""
    lens = Lens(camera.focal_px, (float(camera.matrix[0, 2]), float(camera.matrix[1, 2])), is_known=True)
    return replace(track, keypoints_px=camera.undistorted_px(track.keypoints_px), lens=lens)


def _pose(camera: CalibratedCamera) -> tuple[Array, Array]:
    """Return rotation from the world to the camera (3, 3), our axes, and its place in the world (3,)."""
    turn = rotmat_from_unitquat(unitquat_from_rotvec(camera.rotvec))
    return np.diag([1.0, -1.0, -1.0]) @ turn, camera.position_m


def _of(people: ReconstructedPeople, person_id: int) -> ReconstructedTrack:
    return next(person for person in people.methods[-1].people if person.person_id == person_id)


def _upright_m(people: ReconstructedPeople, person: ReconstructedTrack) -> Array:
    """Return a person in the frame of the sequence (frame, 14, 3): upright, lowest ankle at 0."""
    return np.asarray((person.positions_m - people.methods[-1].origin_m) @ people.camera_from_upright_rotmat)


def _rising(people: ReconstructedPeople, rate_hz: float) -> dict[int, Rising]:
    return {
        person.person_id: Rising.of(person.track.times_s, _upright_m(people, person), ~person.is_bridged, rate_hz)
        for person in people.methods[-1].people
    }


def _times(people: Sequence[ReconstructedTrack]) -> Array:
    """Return the times of all frames of the first camera, from the first to the last of anybody (frame,)."""
    tracks = [person.track for person in people]
    first = min(tracks, key=lambda track: track.first_frame)
    count = max(int(track.frames[-1]) for track in tracks) - first.first_frame + 1
    return np.asarray(first.first_time_s + np.arange(count) / first.rate_hz)


def _moments(people: Sequence[ReconstructedTrack | None], times_s: Array) -> Moments:
    """Return the keypoints of people at times (frame,) by the camera's clock, interpolated between its frames."""
    shape = (len(times_s), len(people), OP14.num_joints)
    px, speed, confidence = np.full((*shape, 2), np.nan), np.zeros((*shape, 2)), np.zeros(shape)
    for number, person in enumerate(people):
        if person is None or len(person.track.frames) < 2:
            continue
        track = person.track
        place = (times_s - track.first_time_s) * track.rate_hz
        inside = np.flatnonzero((place > -1e-6) & (place < len(track.frames) - 1 + 1e-6))
        before = np.clip(np.floor(place[inside] + 1e-6).astype(int), 0, len(track.frames) - 2)
        share = (place[inside] - before)[:, None, None]
        low, high = (
            np.where((track.confidence > 0)[..., None], track.keypoints_px, np.nan)[before + late] for late in (0, 1)
        )
        # A moment that is a frame needs no neighbour.
        low, high = np.where(share > 1.0 - 1e-6, high, low), np.where(share < 1e-6, low, high)
        px[inside, number] = low + share * (high - low)
        reach = max(1, round(_SPEED_S * track.rate_hz))
        early, late = np.maximum(before - reach, 0), np.minimum(before + 1 + reach, len(track.frames) - 1)
        way_px = track.keypoints_px[late] - track.keypoints_px[early]
        speed[inside, number] = np.nan_to_num(way_px * track.rate_hz / (late - early)[:, None, None])
        sure = np.where(share[..., 0] > 0.5, track.confidence[before + 1], track.confidence[before])
        confidence[inside, number] = np.where(np.isfinite(px[inside, number]).all(axis=-1), sure, 0.0)
    return Moments(px, speed, confidence)


def _placed(
    first: ReconstructedPeople,
    other: ReconstructedPeople,
    seen: Sequence[ReconstructedTrack | None],
    theirs: Sequence[ReconstructedTrack | None],
    offset_s: float,
) -> tuple[Array, Array]:
    """Return rotation (3, 3) and place (3,) of another camera in axes of the first, by their upright people.

    The people by one camera alone are turned about the vertical and displaced onto those by the other.
    """
    ours_m, theirs_m = [], []
    for person, same in zip(seen, theirs, strict=True):
        if person is None or same is None:
            continue
        times_s = person.track.times_s + offset_s
        is_both = (times_s >= same.track.times_s[0]) & (times_s <= same.track.times_s[-1])
        moved = interpolate(times_s[is_both], same.track.times_s, _upright_m(other, same))
        ours_m.append(_upright_m(first, person)[is_both].reshape(-1, 3))
        theirs_m.append(moved.reshape(-1, 3))
    ours, them = np.concatenate(ours_m), np.concatenate(theirs_m)
    a, b = ours - ours.mean(axis=0), them - them.mean(axis=0)
    turn = yaw_rotmat(np.arctan2((b[:, 2] * a[:, 0] - b[:, 0] * a[:, 2]).sum(), (b[:, [0, 2]] * a[:, [0, 2]]).sum()))
    shift = ours.mean(axis=0) - turn @ them.mean(axis=0)
    upright, upright_other = first.camera_from_upright_rotmat, other.camera_from_upright_rotmat
    origin, origin_other = first.methods[-1].origin_m, other.methods[-1].origin_m
    position_m = origin + upright @ (shift - turn @ upright_other.T @ origin_other)
    return np.asarray(upright_other @ turn.T @ upright.T), np.asarray(position_m)


def _stature_m(people: Sequence[ReconstructedTrack | None], options: SequenceOptions) -> float:
    """Return the stature of a person: stated, else the mean of the estimates by each camera alone."""
    assert people[0] is not None
    if stated := options.statures_m.get(people[0].person_id):
        return stated
    each = [SeenPerson(person).stature_m for person in people if person is not None]
    return float(np.exp(np.mean(np.log(each))))


def _up(alone: Sequence[ReconstructedPeople], views: Sequence[View]) -> PitchEstimate:
    """Return the pitch of the first camera from the upright axes of all cameras; the given pitch, if any."""
    pitch = alone[0].pitch
    if pitch.is_given:
        return pitch
    weights = np.array([1.0 / max(people.pitch.deviation_rad, _GIVEN_PITCH_RAD) ** 2 for people in alone])
    ups = np.array([view.rotmat.T @ up_axis(people.pitch.pitch_rad) for people, view in zip(alone, views, strict=True)])
    up = weights @ ups
    return replace(pitch, pitch_rad=float(np.arctan2(up[2], up[1])), deviation_rad=float(1.0 / np.sqrt(weights.sum())))
