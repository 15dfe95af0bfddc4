"""Ambiguous videos: a person who may lie before a steep camera, and an implausible camera.

A person who lies with the feet towards the camera looks like a standing person, and the pitch was chosen accordingly.
So matches are compared with lying poses, by the distance of the nearest projections.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.errors import InputError
from pasdedeux.reconstruction.lying import is_on_floor, laid_down, searcher_over
from pasdedeux.reconstruction.matching import Matches, Searcher, match_track
from pasdedeux.reconstruction.scene import SceneEstimate
from pasdedeux.reconstruction.tracks import Track

_STEEP_RAD, _LIES, _STANDS, _LIES_SURELY = float(np.deg2rad(15.0)), 1.2, 1.4, 0.7
"""Before a camera that looks down by more, a person who lies with the feet towards it looks upright.  Limits of the
ratio of distances, lying poses over matches.  Up to 1.2 over the track, both may be right (1.0 for one person who lies
so, 1.4 and more for 30 who stand), unless the ratio reaches 1.4 within some second: then the person stands.  At 0.7 or
less within a second, the person lies: 0.09 to 0.59 for eight walkers laid down for the last third, 0.74 and more for 28
clips of people on their feet."""
_MIN_LENS, _MIN_HEIGHT_M = 0.5, 0.45
"""Smallest plausible focal length over the assumed one, and height of a camera.  Of 90 clips before cameras that look
up by 8 degrees at most, one is below: its camera was found under the floor."""
_NUM_PROJECTIONS, _STRIDE = 200_000, 5
"""Number of projections, and stride over the frames, that are compared."""


def seen_otherwise(searcher: Searcher, matched: Sequence[tuple[Track, Matches]]) -> dict[int, str]:
    """Return warnings by person id: the image may show a lying person just as well.

    Args:
        searcher: Database of the matches, without lying poses.
        matched: Tracks and their matches; tracks of people on the floor are not judged.
    """
    upright = [(track, matches) for track, matches in matched if not is_on_floor(track)]
    if not upright or searcher.database.camera.pitch_rad <= _STEEP_RAD:
        return {}
    database = searcher.database.thinned(_NUM_PROJECTIONS)
    laid = searcher_over(database, *laid_down(database, _NUM_PROJECTIONS))
    return {
        (name := track.person_id): (
            f"person {name} may lie, feet to the steep camera, which looks the same: key frames in 3D help"
        )
        for track, matches in upright
        if may_lie(*_distances_m(laid, track, matches), frames_per_s=track.rate_hz / _STRIDE)
    }


def doubt_of_camera(scene: SceneEstimate, *, is_lens_known: bool, is_height_given: bool) -> str:
    """Return a warning if the camera of a scene is implausible, such as just above the floor, else an empty text.

    A camera below the floor is plausible, because it may stand before a stage.
    """
    is_odd = scene.lens_factor < _MIN_LENS and not is_lens_known
    if not is_odd and (not 0.0 <= scene.camera_height_m <= _MIN_HEIGHT_M or is_height_given):
        return ""
    return (
        f"implausible camera: {scene.height_in_words}, focal length {scene.lens_factor:.2f} of the assumed one; state "
        "its pitch, height or lens"
    )


def may_lie(laid_m: Array, upright_m: Array, *, frames_per_s: float) -> bool:
    """Return whether a person matched to upright poses may lie.

    Args:
        laid_m: Distances of the nearest lying poses (frame,), metres.
        upright_m: Distances of the matches (frame,), metres.
        frames_per_s: Compared frames per second.
    """
    if not len(laid_m) or not np.median(upright_m) > 0:
        return False
    seconds = np.array_split(np.arange(len(laid_m)), max(1, round(len(laid_m) / frames_per_s)))
    ratios = np.array([np.median(laid_m[at]) / max(np.median(upright_m[at]), 1e-9) for at in seconds])
    is_alike = np.median(laid_m) < _LIES * np.median(upright_m) and ratios.max() < _STANDS
    return bool(is_alike or ratios.min() <= _LIES_SURELY)


def _distances_m(other: Searcher, track: Track, matches: Matches) -> tuple[Array, Array]:
    """Return the distances of the matches of another searcher, and of the known ones (frame,), in every fifth frame."""
    try:
        laid_m = match_track(other, track.every(_STRIDE)).neighbours.distance_m[:, 0]
    except InputError:
        return np.zeros(0), np.zeros(0)
    upright_m = matches.neighbours.distance_m[::_STRIDE, 0]
    is_matched = np.isfinite(laid_m) & np.isfinite(upright_m)
    return laid_m[is_matched], upright_m[is_matched]
