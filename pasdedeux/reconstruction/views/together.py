"""The people of a take from several cameras: each camera alone, then clocks, cameras and poses of all together."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.cameras.pinhole import PinholeCamera
from pasdedeux.errors import InputError
from pasdedeux.kinematics.forward import bone_lengths
from pasdedeux.kinematics.rotations import yaw_rotmat
from pasdedeux.reconstruction.people import ReconstructedPeople, SequenceOptions, place_people
from pasdedeux.reconstruction.pitch import PitchEstimate
from pasdedeux.reconstruction.reconstruct import MIN_JOINTS, ReconstructedTrack
from pasdedeux.reconstruction.sequence import SearchedDatabase, StatedCamera, reconstruct_sequence
from pasdedeux.reconstruction.terms.placed import SeenPerson, up_axis
from pasdedeux.reconstruction.tracks import Lens, Track
from pasdedeux.reconstruction.views.calibration import View, calibrate, lengths_of, meet
from pasdedeux.reconstruction.views.clocks import Rising, match_cameras
from pasdedeux.reconstruction.views.fit import fit_person
from pasdedeux.skeletons import OP14

_NUM_PASSES = 2
"""Calibrations; the second with keypoints taken at the clocks of the first."""
_GIVEN_PITCH_RAD = 0.01
"""Standard deviation of a pitch that is given."""


class Moments(NamedTuple):
    """What a camera sees of people (frame, person, 14): pixels, their speed, and confidence, see `View`."""

    px: Array
    speed_px_s: Array
    confidence: Array


@dataclass(frozen=True)
class SeenTogether:
    """A take that several cameras saw.

    Args:
        people: The people before the first camera.
        views: All cameras, in its axes.
        off_m: Median distance of joints from the rays in which they are seen.
    """

    people: ReconstructedPeople
    views: tuple[View, ...]
    off_m: float

    def in_words(self) -> str:
        """Say where the cameras were, and how well they agree."""
        words = [f"{len(self.views)} cameras: joints are {100 * self.off_m:.1f} cm (median) from where each sees them"]
        for number, view in enumerate(self.views[1:], start=2):
            turned = np.rad2deg(np.arccos(np.clip(view.rotmat[2, 2], -1.0, 1.0)))
            words.append(
                f"camera {number} is {np.linalg.norm(view.position_m):.1f} m from the first, turned by {turned:.0f} "
                f"degrees, its clock {view.offset_s:+.2f} s"
            )
        return "; ".join(words)


def reconstruct_views(
    cameras: Sequence[Sequence[Track]],
    database: SearchedDatabase,
    stated: StatedCamera | None = None,
    options: SequenceOptions | None = None,
    *,
    calibration: Sequence[PinholeCamera] = (),
    on_camera: Callable[[], None] = lambda: None,
) -> SeenTogether:
    """Reconstruct the people of a take that several cameras saw, in the frames of the first one.

    Args:
        cameras: Tracks of people by camera, at least two cameras; numbers of people may differ between them.
        database: Poses that have not seen the take.
        stated: What is known of the first camera.
        options: Clean-up, and statures by the numbers of the first camera.
        calibration: The cameras where they are given, in any world in metres; else the people tell where they are.
        on_camera: Called when a camera is reconstructed alone.

    Raises:
        InputError: Before a camera nobody can be reconstructed, the cameras do not show the same people, or their
            number is not that of the calibration.
    """
    options = options or SequenceOptions()
    if calibration and len(calibration) != len(cameras):
        raise InputError(f"the calibration has {len(calibration)} cameras, and {len(cameras)} are given")
    alone = []
    for number, tracks in enumerate(cameras):
        if calibration:
            tracks = [replace(track, lens=_lens(calibration[number])) for track in tracks]
        found = reconstruct_sequence(
            tracks,
            database,
            stated if number == 0 else None,
            replace(options, has_clean_up=False, statures_m={} if number else options.statures_m),
        ).people
        if not found.methods:
            raise InputError(f"camera {number + 1}: {next(iter(found.skipped.values()), 'it shows nobody')}")
        alone.append(found)
        on_camera()
    rate_hz = alone[0].methods[-1].people[0].track.rate_hz
    rising = [_rising(found, rate_hz) for found in alone]
    same = [match_cameras(rising[0], other, rate_hz) for other in rising[1:]]
    names = sorted({name for take in same for name in take.person_ids.values()})
    # By camera and person of the take: how that camera alone sees the person, or None.
    seen = [[_of(alone[0], name) for name in names]]
    for found, take in zip(alone[1:], same, strict=True):
        theirs = {name: own for own, name in take.person_ids.items()}
        seen.append([_of(found, theirs[name]) if name in theirs else None for name in names])
    times_s = _times(seen[0])
    views = []
    for number, people in enumerate(seen):
        lens = next(person.track.lens for person in people if person is not None)
        offset_s = same[number - 1].offset_s if number else 0.0
        rotmat, position_m = np.eye(3), np.zeros(3)
        if number and calibration:
            first, other = calibration[0], calibration[number]
            rotmat = other.camera_from_world_rotmat @ first.camera_from_world_rotmat.T
            position_m = first.camera_from_world(other.position_m)
        elif number:
            rotmat, position_m = _placed(alone[0], alone[number], seen[0], people, offset_s)
        views.append(View(lens, rotmat, position_m, offset_s, *_moments(people, times_s + offset_s), bool(calibration)))
    statures_m = np.array([_stature_m(column, options) for column in zip(*seen, strict=True)])
    for _ in range(_NUM_PASSES):
        views = calibrate(views, statures_m, rate_hz)
        views = [
            replace(view, **_moments(people, times_s + view.offset_s)._asdict())
            for view, people in zip(views, seen, strict=True)
        ]
    lengths_m = lengths_of(meet(views))[1]
    made, off_m = [], []
    for number, person in enumerate(seen[0]):
        assert person is not None
        frames = np.searchsorted(times_s, person.track.times_s - 1e-6)
        own = [view.chosen(frames) for view in views]
        lengths = np.where(lengths_m[number] > 0, lengths_m[number], bone_lengths(OP14, person.positions_m[:1])[0])
        fitted = fit_person(own, number, person.positions_m, lengths, rate_hz)
        is_seen = np.any([(view.confidence[:, number] > 0).sum(axis=1) >= MIN_JOINTS for view in own], axis=0)
        made.append(replace(person.posed(fitted.positions_m), is_bridged=~is_seen))
        off_m.append(fitted.off_m)
    lens_factor = views[0].lens.focal_px / seen[0][0].track.lens.focal_px
    people = place_people(alone[0], made, _up(alone, views), lens_factor, database.poses, options)
    return SeenTogether(people, tuple(views), float(np.mean(off_m)))


def _lens(camera: PinholeCamera) -> Lens:
    x, y = camera.principal_point_px
    return Lens(camera.focal_px, (float(x), float(y)), is_known=True)


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


def _times(people: Sequence[ReconstructedTrack | None]) -> Array:
    """Return the times of all frames of the first camera, from the first to the last of anybody (frame,)."""
    tracks = [person.track for person in people if person is not None]
    first = min(tracks, key=lambda track: track.first_frame)
    count = max(int(track.frames[-1]) for track in tracks) - first.first_frame + 1
    return np.asarray(first.first_time_s + np.arange(count) / first.rate_hz)


def _moments(people: Sequence[ReconstructedTrack | None], times_s: Array) -> Moments:
    """Return what a camera sees of people at times (frame,) by its clock, between its frames by interpolation."""
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
        speed[inside, number] = np.nan_to_num((high - low) * track.rate_hz)
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
    """Return rotation and place of another camera (3, 3), (3,) before the first, as both see the people upright.

    What one camera alone takes the people to be is turned about the vertical and displaced to what the other does.
    """
    ours_m, theirs_m = [], []
    for own, same in zip(seen, theirs, strict=True):
        if own is None or same is None:
            continue
        times_s = own.track.times_s + offset_s
        is_both = (times_s >= same.track.times_s[0]) & (times_s <= same.track.times_s[-1])
        flat = _upright_m(other, same).reshape(len(same.track.frames), -1)
        moved = np.stack([np.interp(times_s[is_both], same.track.times_s, one) for one in flat.T], axis=-1)
        ours_m.append(_upright_m(first, own)[is_both].reshape(-1, 3))
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
    """Return the stature of a person: stated, else the mean of what each camera alone takes it to be."""
    assert people[0] is not None
    if stated := options.statures_m.get(people[0].person_id):
        return stated
    each = [SeenPerson(person).stature_m for person in people if person is not None]
    return float(np.exp(np.mean(np.log(each))))


def _up(alone: Sequence[ReconstructedPeople], views: Sequence[View]) -> PitchEstimate:
    """Return the pitch of the first camera as all cameras tell where up is; as given, if it was."""
    pitch = alone[0].pitch
    if pitch.is_given:
        return pitch
    weights = np.array([1.0 / max(found.pitch.deviation_rad, _GIVEN_PITCH_RAD) ** 2 for found in alone])
    ups = np.array([view.rotmat.T @ up_axis(found.pitch.pitch_rad) for found, view in zip(alone, views, strict=True)])
    up = weights @ ups
    return replace(pitch, pitch_rad=float(np.arctan2(up[2], up[1])), deviation_rad=float(1.0 / np.sqrt(weights.sum())))
