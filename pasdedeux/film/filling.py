"""Filling gaps between known joints: tracks from both sides combined with shape-preserving interpolation.

At the end of a gap a track differs from the known joint.  This drift measures its quality, and is distributed over the
gap.  Both corrected tracks and the interpolation are weighted by their inverse variances, in body heights.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from pasdedeux.arrays import Array, Flags, Integers
from pasdedeux.film.tracking import Tracks
from pasdedeux.formats.poses2d.annotated_frames import KeypointStatus
from pasdedeux.skeletons.layouts.names import SIDES
from pasdedeux.skeletons.skeleton import ARM, LEG

# Lengths are shares of the size of the person in the image (about its height).
_TRACK_DEVIATION, _CURVE_DEVIATION = 0.015, 0.06
"""Deviation of a track without drift, and of interpolation in the middle of a gap: tuned on rendered salsa."""
_MAX_INTERPOLATED_S, _MAX_ONE_SIDED_S = 1.0, 0.3
"""Maximum gap for interpolation without tracks; maximum length of a track with one known end."""
_MAX_DRIFT = 0.15
"""Maximum drift of a reliable track."""
_DOUBTED = 0.06
"""Deviation at which the confidence of a filled joint is half that of its ends."""
_LEAST_CONFIDENCE = 0.25
"""Minimum confidence of a filled joint, above the threshold of ingest."""
_MIN_FOLLOWED = 3
"""Minimum number of followed joints of a person by which the others are moved along."""
_MAX_STRETCH = 1.1
"""Maximum length of a filled limb relative to its known maximum."""
_LIMBS = [bone for side in SIDES for limb in (ARM, LEG) for bone in pairwise(f"{side}_{joint}" for joint in limb)]


@dataclass(frozen=True)
class FilledPoints:
    """Points in every frame.

    Args:
        px: (frame, point, 2), NaN where missing.
        confidence: (frame, point), 0 where missing.
        status: (frame, point) of `KeypointStatus`.
        doubt: Disagreement of tracks and known places (frame, point), in sizes of the person; 0 if there is none.
    """

    px: Array
    confidence: Array
    status: Integers
    doubt: Array


def fill_points(
    known_px: Array,
    confidence: Array,
    status: Integers,
    tracks: Tracks,
    size_px: Array,
    *,
    rate_hz: float,
    is_hidden: Flags,
    person: Integers,
) -> FilledPoints:
    """Fill the gaps between known places of points.

    Args:
        known_px: (frame, point, 2), NaN where not known.
        confidence: (frame, point), 0 where not known.
        status: Status of known places (frame, point).
        tracks: Tracks of the same points.
        size_px: Size of each point's person (point,).
        rate_hz: Frames per second.
        is_hidden: Where a point is known to be hidden (frame, point); no track passes there.
        person: Person of each point (point,), with which it moves if it cannot be followed.
    """
    px, sure, kind = known_px.copy(), confidence.copy(), status.copy()
    doubt = np.zeros(confidence.shape)
    paths = _paths(known_px, tracks.forward, person)
    for point, size in enumerate(size_px.tolist()):
        known = np.flatnonzero(np.isfinite(known_px[:, point, 0]))
        if len(known) == 0:
            continue
        path = paths[:, point]
        curve = path + _curve(known, known_px[known, point] - path[known], len(px))
        forward, backward = (track[:, point] for track in (tracks.forward, tracks.backward))
        ends = [-1, *known.tolist(), len(px)]
        for start, stop in pairwise(ends):
            inside = np.arange(start + 1, stop)
            if len(inside) == 0:
                continue
            hidden = is_hidden[inside, point]
            is_two_sided = start >= 0 and stop < len(px) and not hidden.any()
            share = (inside - start) / (stop - start)
            candidates = [
                _bridged(forward, known_px[:, point], inside, share, start, stop, size, is_two_sided),
                _bridged(backward, known_px[:, point], inside, 1.0 - share, stop, start, size, is_two_sided),
            ]
            apart = np.linalg.norm(forward[inside] - backward[inside], axis=-1) / size
            doubt[inside, point] = np.nan_to_num(apart)
            if is_two_sided:
                deviation = _CURVE_DEVIATION * 2.0 * np.sqrt(share * (1.0 - share))
                is_curve = np.full(len(inside), (stop - start) / rate_hz <= _MAX_INTERPOLATED_S)
                candidates.append((curve[inside], np.where(is_curve, deviation**2, np.inf)))
            else:
                reach = _MAX_ONE_SIDED_S * rate_hz
                after = inside - start if start >= 0 else np.inf
                before = stop - inside if stop < len(px) else np.inf
                # Hidden frames and those beyond them, as seen from the known place, are not filled.
                is_cut = np.logical_or.accumulate(hidden), np.logical_or.accumulate(hidden[::-1])[::-1]
                for (_, variance), away, cut in zip(candidates, (after, before), is_cut, strict=True):
                    variance[cut | (away > reach)] = np.inf
            places = np.stack([np.nan_to_num(place) for place, _ in candidates])
            weights = np.stack([1.0 / variance for _, variance in candidates])
            total = weights.sum(axis=0)
            filled, is_filled = inside[total > 0], total > 0
            px[filled, point] = (np.einsum("ci,cik->ik", weights, places)[is_filled]) / total[is_filled, None]
            ends_sure = [confidence[end, point] for end in (start, stop) if 0 <= end < len(px)]
            belief = min(ends_sure) / (1.0 + (1.0 / np.sqrt(total[is_filled]) / _DOUBTED) ** 2)
            sure[filled, point] = np.maximum(belief, _LEAST_CONFIDENCE)
            is_tracked = weights[:2].sum(axis=0) >= 0.5 * total
            kind[inside, point] = np.where(is_tracked, KeypointStatus.TRACKED, KeypointStatus.INTERPOLATED)
            kind[inside[~is_filled], point] = KeypointStatus.MISSING
        for reached in (forward, backward):
            drift = np.linalg.norm(reached[known] - known_px[known, point], axis=-1) / size
            is_found = status[known, point] != KeypointStatus.ANNOTATED  # annotations are not doubted
            doubt[known, point] = np.maximum(doubt[known, point], is_found * np.nan_to_num(drift))
    return FilledPoints(px, np.where(kind == KeypointStatus.MISSING, 0.0, sure), kind, doubt)


def shorten_limbs(filled: FilledPoints, joint_names: tuple[str, ...]) -> Array:
    """Return the places (frame, point, 2) with filled limbs limited to about their known lengths in this shot.

    The end of a limb that is too long is moved towards its start; known places do not change.

    Args:
        filled: Points, person by person with all joints of each.
        joint_names: Joints of a person.
    """
    px = filled.px.copy()
    is_known = filled.status >= KeypointStatus.DETECTED
    for person in range(px.shape[1] // len(joint_names)):
        for limb in _LIMBS:
            if not set(limb) <= set(joint_names):
                continue
            parent, child = (person * len(joint_names) + joint_names.index(name) for name in limb)
            along = px[:, child] - px[:, parent]
            length = np.linalg.norm(along, axis=-1)
            both = is_known[:, parent] & is_known[:, child]
            if both.any():
                limit = _MAX_STRETCH * float(length[both].max())
                is_long = (length > limit) & ~is_known[:, child]
                px[is_long, child] = px[is_long, parent] + along[is_long] * (limit / length[is_long])[:, None]
    return px


def _paths(known_px: Array, forward: Array, person: Integers) -> Array:
    """Return the path of each point's person (frame, point, 2), from 0, by the joints that are followed.

    The step between frames is the median of the steps of these joints, or 0 if there are fewer than three.
    """
    steps = forward[1:] - np.where(np.isfinite(known_px), known_px, forward)[:-1]
    paths = np.zeros(known_px.shape)
    for who in np.unique(person):
        own_steps = steps[:, person == who]
        is_followed = np.isfinite(own_steps[..., 0]).sum(axis=1) >= _MIN_FOLLOWED
        step = np.zeros((len(own_steps), 1, 2))
        step[is_followed, 0] = np.nanmedian(own_steps[is_followed], axis=1)
        paths[1:, person == who] = np.cumsum(step, axis=0)
    return paths


def _curve(known: Integers, places: Array, num_frames: int) -> Array:
    """Return the shape-preserving interpolation (frame, 2), NaN outside."""
    if len(known) == 1:
        return np.full((num_frames, 2), np.nan)
    from scipy.interpolate import PchipInterpolator  # here: others need not wait for it

    return np.asarray(PchipInterpolator(known, places, extrapolate=False)(np.arange(num_frames)))


def _bridged(
    reached: Array,
    known: Array,
    inside: Integers,
    share: Array,
    start: int,
    stop: int,
    size_px: float,
    is_two_sided: bool,
) -> tuple[Array, Array]:
    """Return the places (inside, 2) of a track with its drift distributed over the gap, and variances (inside,).

    Args:
        reached: The track (frame, 2).
        known: Known places (frame, 2).
        inside: Frames of the gap.
        share: Position of each in the gap, from 0 at the start of the track to 1.
        start: Known frame at which the track begins.
        stop: Known frame at which it ends.
        size_px: Size of the person.
        is_two_sided: Whether both ends are known and the point is not hidden between them.
    """
    place, variance = reached[inside].copy(), np.full(len(inside), _TRACK_DEVIATION**2)
    drift = reached[stop] - known[stop] if is_two_sided else np.full(2, np.nan)
    if np.isfinite(drift).all():
        place -= share[:, None] * drift
        lost = float(np.linalg.norm(drift)) / size_px
        variance = share * (1.0 - 0.5 * share) * (variance + lost**2)
        if lost > _MAX_DRIFT:
            variance = variance + _CURVE_DEVIATION**2
    else:
        variance = variance * (1.0 + 4.0 * share)
    return place, np.where(np.isfinite(place[:, 0]), variance + 1e-9, np.inf)
