"""Sizes of people from stated facts: statures, and the height of the camera over the floor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np

from pasdedeux.kinematics.forward import bone_lengths
from pasdedeux.plausibility.capsules import body_height_m
from pasdedeux.projections.database import DatabaseCamera
from pasdedeux.reconstruction.reconstruct import ReconstructedTrack
from pasdedeux.skeletons import OP14

_MAX_CONTRADICTION, _MAX_CONTRADICTION_OF_TWO = 1.2, 1.3
"""Largest plausible ratios: of a stated stature to the one implied by the height of the camera, and of the heights
implied by two statures.  Of 49 couples of nine families of takes, 4 differ by more than 1.2 and none by 1.3."""
_STATURES_M = (1.2, 2.2)
"""Range of plausible statures."""
_ANKLE_HEIGHT_M = 0.07
"""Height of the ankle of the reference body over the floor, standing (Winter 2009, fig. 4.1: 0.039 of stature)."""
_STANDING_PERCENT = 10.0
"""Percentile of the height of the lower ankle that counts as standing."""
_SIZE_RANGE = (0.5, 2.0)
"""Range of plausible sizes by the height of the camera, as multiples of the reference body."""
_ANKLES = OP14.indices(["left_ankle", "right_ankle"])


def size_by_height(track: ReconstructedTrack, camera: DatabaseCamera, camera_height_m: float) -> float:
    """Return the factor that scales a person to the size implied by this height of the camera above the floor.

    One camera does not show how large people are: scaling body and path about the camera leaves the image as it is.
    But it also scales the distance of the floor, on which ankles stand, so a known height of the camera gives the size.
    NaN if the feet are not below the camera.
    """
    upright = track.positions_m @ camera.camera_from_upright_rotmat
    lowest = upright[~track.is_bridged][:, _ANKLES, 1].min(axis=1)
    if not len(lowest):
        return float("nan")
    below = _ANKLE_HEIGHT_M - float(np.percentile(lowest, _STANDING_PERCENT))
    return camera_height_m / below if below > 0 else float("nan")


def sized_by_height(track: ReconstructedTrack, camera: DatabaseCamera, camera_height_m: float) -> ReconstructedTrack:
    """Scale a track to its size by the height of the camera; leave it as it is if that size is not plausible."""
    size = size_by_height(track, camera, camera_height_m)
    return track.scaled(size) if _SIZE_RANGE[0] <= size <= _SIZE_RANGE[1] else track


def sized_by_stature(
    tracks: Sequence[ReconstructedTrack], statures_m: Mapping[int, float], *, has_one_size: bool = False
) -> tuple[ReconstructedTrack, ...]:
    """Scale tracks so that people have their stated statures, estimated from their legs.

    Body and path are scaled about the camera, which leaves the image as it is.

    Args:
        tracks: Camera axes, camera at the origin.
        statures_m: Stature by person id; the others are scaled by the mean factor.
        has_one_size: Scale everybody by one factor, which keeps their places relative to each other.
    """
    before_m = {track.person_id: stature_m(track) for track in tracks}
    growth = {name: after_m / before_m[name] for name, after_m in statures_m.items() if before_m.get(name, 0.0) > 0}
    if not growth:
        return tuple(tracks)
    mean = float(np.exp(np.mean(np.log(list(growth.values())))))
    return tuple(track.scaled(mean if has_one_size else growth.get(track.person_id, mean)) for track in tracks)


def statures_implied(
    tracks: Sequence[ReconstructedTrack],
    camera: DatabaseCamera,
    statures_m: Mapping[int, float],
    camera_height_m: float | None,
) -> tuple[dict[int, float], list[str]]:
    """Return statures by person id, stated or implied by the height of the camera, and warnings about contradictions.

    All stand on one floor, so one stature implies the height of the camera, and with it the statures of the others.
    """
    # Statures that a camera one metre above the floor would imply.
    per_metre = {track.person_id: size_by_height(track, camera, 1.0) * stature_m(track) for track in tracks}
    per_metre = {name: ratio for name, ratio in per_metre.items() if np.isfinite(ratio)}
    if camera_height_m is None:
        return dict(statures_m), _contradictions(per_metre, statures_m)
    known, doubts = dict(statures_m), []
    for track in (track for track in tracks if track.person_id in per_metre):
        name = track.person_id
        by_height_m, stated_m = camera_height_m * per_metre[name], statures_m.get(name)
        tall = f"would be {by_height_m:.2f} m tall before a camera {camera_height_m:.2f} m above the floor"
        if stated_m is None and sized_by_height(track, camera, camera_height_m) is not track:
            known[name] = by_height_m
        elif stated_m is None:
            doubts.append(f"person {name} {tall}: that height is wrong, or the pitch")
        elif _ratio(stated_m, by_height_m) > _MAX_CONTRADICTION:
            doubts.append(f"person {name} of {stated_m:.2f} m {tall}: one of both is wrong, or the pitch")
    return known, doubts


def _contradictions(per_metre: Mapping[int, float], statures_m: Mapping[int, float]) -> list[str]:
    """Return warnings about statures that imply different heights of the camera."""
    heights_m = {name: statures_m[name] / ratio for name, ratio in per_metre.items() if name in statures_m}
    doubts = [
        f"the camera would be {heights_m[name]:.2f} m above the floor by person {name} of {statures_m[name]:.2f} m, "
        f"and {heights_m[other]:.2f} m by person {other} of {statures_m[other]:.2f} m: one of both statures is wrong, "
        "or one of the two never stands"
        for name, other in combinations(heights_m, 2)
        if _ratio(heights_m[name], heights_m[other]) > _MAX_CONTRADICTION_OF_TWO
    ]
    if not heights_m or doubts:
        return doubts
    height_m = float(np.exp(np.mean(np.log(list(heights_m.values())))))
    stated = ", ".join(f"{name} of {statures_m[name]:.2f} m" for name in heights_m)
    return [
        f"person {name} would be {tall_m:.2f} m tall beside person {stated}: state that, too"
        for name in sorted(per_metre.keys() - statures_m.keys())
        if not _STATURES_M[0] <= (tall_m := height_m * per_metre[name]) <= _STATURES_M[1]
    ]


def _ratio(first: float, second: float) -> float:
    """Return the larger over the smaller."""
    return max(first / second, second / first)


def stature_m(track: ReconstructedTrack) -> float:
    """Return the stature of a person, estimated from the legs."""
    return float(np.median(body_height_m(OP14, bone_lengths(OP14, track.positions_m))))
