"""Annotation of all frames of a shot from key frames or detections."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from pasdedeux.arrays import Array, Integers
from pasdedeux.errors import InputError, NobodyError
from pasdedeux.film.camera import LOST, CameraFollower
from pasdedeux.film.filling import FilledPoints, fill_points, shorten_limbs
from pasdedeux.film.tracking import TRACKED_SIZE_PX, Image, Tracks, track_points
from pasdedeux.formats.poses2d.annotated_frames import AnnotatedFrames, KeypointStatus, get_keypoint_layout, join_frames
from pasdedeux.people.identity import body_size_px
from pasdedeux.people.resolution import resolve_people
from pasdedeux.skeletons import OP14

MIN_SEEN = 0.5
"""Keypoints of at most this confidence, such as COCO's labelled but hidden ones, are known but not tracked."""


_MIN_GAP = 5
"""One correction covers frames that are nearer to each other than this."""


@dataclass(frozen=True)
class AnnotatedShot:
    """Annotations of all frames of a shot.

    Args:
        frames: People of the shot, with the status of every keypoint.
        doubt: Largest disagreement over the keypoints of each row (row,), in sizes of the person.
    """

    frames: AnnotatedFrames
    doubt: Array


def with_identities(given: AnnotatedFrames, *, is_key: bool) -> AnnotatedFrames:
    """Return the keypoints of key frames or of a detector, with people numbered over time.

    Detections are resolved and cleaned as in ingest.  Key frames are not changed, because a person placed them.

    Raises:
        InputError: There are no keypoints, several people in key frames have no numbers, or detections are too far
            apart to be followed.
    """
    given = given.given()
    if not given.num_rows:
        raise InputError("no keypoint of it was annotated or detected")
    alone = np.unique(given.frame, return_counts=True)[1].max(initial=0) <= 1
    if is_key and (given.has_identities or alone):
        return replace(given, has_identities=True)
    if is_key:
        raise InputError(
            "its key frames do not number the people (COCO: track_id; CSV: person; CVAT: tracks), who move too far "
            "between key frames to be followed"
        )
    resolved = resolve_people(replace(given, confidence=np.where(given.is_given, given.confidence, 0.0)))
    why = next((sequence.why_not_followed for sequence in resolved.sequences if sequence.why_not_followed), "")
    if why:
        raise NobodyError(why)
    return replace(resolved.frames, has_identities=True)


def annotate_shot(
    given: AnnotatedFrames, images: Iterable[Image], first_frame: int, num_frames: int, *, is_key: bool
) -> AnnotatedShot:
    """Fill in all frames of a shot from the given ones.

    Args:
        given: Rows of the shot, with identities and rate; their filled-in keypoints are filled in again.
        images: BGR images of all frames of the shot.
        first_frame: Number of the first frame.
        num_frames: Number of frames.
        is_key: Whether they are key frames, whose missing keypoints are hidden; keypoints that a detector misses may be
            visible.
    """
    assert given.rate_hz is not None
    names = get_keypoint_layout(given.layout).keypoint_names
    people = np.unique(given.person_id)
    shape = (num_frames, len(people), len(names))
    known, confidence = np.full((*shape, 2), np.nan), np.zeros(shape)
    kind, is_hidden = np.zeros(shape, dtype=np.int64), np.zeros(shape, dtype=bool)
    at = (given.frame - first_frame, np.searchsorted(people, given.person_id))
    is_given = given.is_given
    known[at] = np.where(is_given[..., None], given.keypoints_px, np.nan)
    confidence[at] = np.where(is_given, given.confidence, 0.0)
    source = KeypointStatus.ANNOTATED if is_key else KeypointStatus.DETECTED
    kind[at] = np.where(is_given, source if given.status is None else given.status, 0)
    is_hidden[at] = is_key & (given.confidence == 0)
    op14 = get_keypoint_layout(given.layout).derive(OP14.name, given.keypoints_px, given.confidence)
    each = body_size_px(op14.positions, op14.confidence)
    size = np.array([_median(each[given.person_id == person], 0.0) for person in people])
    size = np.where(size > 0, size, _median(size[size > 0], TRACKED_SIZE_PX))
    scale = min(1.0, TRACKED_SIZE_PX / float(size.max()))
    points, sizes = shape[1] * shape[2], np.repeat(size, shape[2])
    flat = known.reshape(num_frames, points, 2)
    focal_px = given.focal_px.get(given.sequence_id[0]) if len(given.frame) else None
    follower = CameraFollower(_boxes(known, scale), None if focal_px is None else scale * focal_px)

    def passing() -> Iterator[Image]:
        for image in images:
            grey = _grey(image, scale)
            follower.add(grey)
            yield grey

    # Pixel centres: the centre of a pixel of the smaller image is the centre of the pixels it replaces.
    tracks = track_points(
        passing(),
        (flat + 0.5) * scale - 0.5,
        confidence.reshape(num_frames, points) > MIN_SEEN,
        sizes * scale,
        is_checked=not is_key,
    )
    tracks = Tracks(*((track + 0.5) / scale - 0.5 for track in (tracks.forward, tracks.backward)))
    filled = fill_points(
        flat,
        confidence.reshape(num_frames, points),
        kind.reshape(num_frames, points),
        tracks,
        sizes,
        rate_hz=given.rate_hz,
        is_hidden=is_hidden.reshape(num_frames, points),
        person=np.repeat(np.arange(shape[1]), shape[2]),
    )
    motion, is_lost = follower.motion(first_frame)
    given = replace(
        given,
        camera_motion={} if motion is None else {given.sequence_id[0]: motion.resized(1.0 / scale)},
        doubts=(*given.doubts, *((LOST,) if is_lost else ())),
    )
    return _rows(given, replace(filled, px=shorten_limbs(filled, names)), first_frame, people)


def correct_keypoint(
    shot: AnnotatedShot,
    frame: int,
    person_id: int,
    keypoint: int,
    point_px: Array,
    images: Callable[[int, int], Iterable[Image]],
    *,
    is_key: bool,
) -> AnnotatedShot:
    """Place a keypoint of a shot, and track it again from there to the known frames on both sides.

    Args:
        shot: The shot.
        frame: The frame.
        person_id: The person.
        keypoint: Index of the keypoint.
        point_px: Its new place (2,).
        images: Returns the BGR images from one frame up to another, within the shot.
        is_key: As in `annotate_shot`.

    Raises:
        InputError: The person is not in the frame.
    """
    frames, doubt = shot.frames, shot.doubt.copy()
    assert frames.status is not None
    px, confidence, status = frames.keypoints_px.copy(), frames.confidence.copy(), frames.status.copy()
    is_own = frames.person_id == person_id
    here = np.flatnonzero(is_own & (frames.frame == frame))
    if not len(here):
        raise InputError(f"person {person_id} is not in frame {frame}: there is nobody whose joints can be corrected")
    px[here, keypoint], confidence[here, keypoint], status[here, keypoint] = point_px, 1.0, KeypointStatus.ANNOTATED
    known = frames.frame[is_own & (status[:, keypoint] >= KeypointStatus.DETECTED)]
    first = int(known[known < frame].max(initial=frames.frame.min()))
    last = int(known[known > frame].min(initial=frames.frame.max()))
    is_near = is_own & (frames.frame >= first) & (frames.frame <= last)
    corrected = replace(frames, keypoints_px=px, confidence=confidence, status=status)
    part = annotate_shot(
        corrected.rows(is_near).given(), images(first, last + 1), first, last + 1 - first, is_key=is_key
    )
    assert part.frames.status is not None
    # Only this keypoint is taken from the part.  It is missing if the part lacks it, and frames in which nothing else
    # of the person is seen gain or lose their row.
    near = np.flatnonzero(is_near)
    px[near, keypoint] = np.nan
    is_gained = ~np.isin(part.frames.frame, frames.frame[near])
    rows, again = near[np.isin(frames.frame[near], part.frames.frame)], part.frames.rows(~is_gained)
    assert again.status is not None
    px[rows, keypoint], confidence[rows, keypoint] = again.keypoints_px[:, keypoint], again.confidence[:, keypoint]
    status[rows, keypoint] = again.status[:, keypoint]
    doubt[rows] = part.doubt[~is_gained]
    kept = replace(frames, keypoints_px=px, confidence=confidence, status=status)
    gained = part.frames.rows(is_gained)
    is_keypoint = np.arange(px.shape[1]) == keypoint
    joined = join_frames([kept, replace(gained, confidence=np.where(is_keypoint, gained.confidence, 0.0))])
    person, number = (np.concatenate([getattr(kept, key), getattr(gained, key)]) for key in ("person_id", "frame"))
    order = np.lexsort([person, number])
    is_seen = np.asarray((joined.confidence > 0).any(axis=1))
    return AnnotatedShot(joined.rows(is_seen), np.concatenate([doubt, part.doubt[is_gained]])[order][is_seen])


def _rows(given: AnnotatedFrames, filled: FilledPoints, first_frame: int, people: Integers) -> AnnotatedShot:
    shape = (len(filled.px), len(people), -1)
    confidence = filled.confidence.reshape(shape)
    frame, person = np.nonzero((confidence > 0).any(axis=-1))
    frames = replace(
        given,
        sequence_id=(given.sequence_id[0],) * len(frame),
        frame=first_frame + frame,
        person_id=people[person],
        keypoints_px=filled.px.reshape(*shape, 2)[frame, person],
        confidence=confidence[frame, person],
        status=filled.status.reshape(shape)[frame, person],
        has_identities=True,
    )
    return AnnotatedShot(frames, filled.doubt.reshape(shape)[frame, person].max(axis=1))


def _boxes(known_px: Array, scale: float) -> Array:
    """Return the boxes (frame, person, 2, 2) of people in the smaller image, interpolated between known frames."""
    is_known = np.isfinite(known_px[..., 0])
    boxes = np.full((*known_px.shape[:2], 2, 2), np.nan)
    frames = np.arange(len(known_px))
    for person in range(known_px.shape[1]):
        shown = np.flatnonzero(is_known[:, person].any(axis=-1))
        for end, take in enumerate((np.nanmin, np.nanmax) if len(shown) else ()):
            corner = take(known_px[shown, person], axis=1)
            for axis in range(2):
                boxes[:, person, end, axis] = np.interp(frames, shown, corner[:, axis])
    return scale * boxes


def _grey(image: Image, scale: float) -> Image:
    import cv2  # here: a quarter of a second that others need not wait for

    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    if scale == 1.0:
        return np.asarray(grey)
    return np.asarray(cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))


def _median(values: Array, otherwise: float) -> float:
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) else otherwise


def frames_to_correct(shot: AnnotatedShot, count: int) -> list[int]:
    """Return the frames whose correction helps most, most first: those with the largest doubt.

    Of frames that one correction covers, only one is returned.
    """
    number, at = np.unique(shot.frames.frame, return_inverse=True)
    doubt = np.zeros(len(number))
    np.maximum.at(doubt, at, shot.doubt)
    chosen: list[int] = []
    for index in np.argsort(-doubt, kind="stable").tolist():
        if len(chosen) == count or doubt[index] <= 0:
            break
        if all(abs(int(number[index]) - frame) >= _MIN_GAP for frame in chosen):
            chosen.append(int(number[index]))
    return chosen
