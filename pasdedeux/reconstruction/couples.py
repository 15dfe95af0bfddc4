"""The depth between two people who move together, by pairs of a database that look like both.

With one camera, the distance of a person follows from the size in the image, so errors of body size and lens become
errors of the depth between two people.  Pairs of the database that look like the two show that depth, whatever the
lens.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array, Integers
from pasdedeux.kinematics.rotations import rotate, swing_between
from pasdedeux.projections.database import Database
from pasdedeux.projections.pairs import pair_database, search_pairs
from pasdedeux.projections.retarget import mid_hip
from pasdedeux.projections.search import ProjectionIndex, build_index
from pasdedeux.reconstruction.matching import Matches
from pasdedeux.reconstruction.proportions import retarget_image
from pasdedeux.reconstruction.reconstruct import ReconstructedTrack
from pasdedeux.skeletons import OP14

_NUM_CANDIDATES = 20
"""Number of pairs compared per frame."""
_MISFIT_M = 0.02
"""Pairs whose image is this much worse than the best have weight 1/e."""
_DEVIATION_PER_MISFIT = 2.0
"""Standard deviation of a pair's depth over the misfit of its image."""
_MIN_DEVIATION_M = 0.03
"""Smallest standard deviation of a pair's depth."""
_MAX_APART_M = 1.5
"""Largest distance of the two in the image; frames beyond are excluded."""


@dataclass(frozen=True)
class PairDepth:
    """How much nearer one of two people is than the other, along the ray to their middle, by pairs of a database.

    Args:
        people: Numbers of the two.
        frames: Frames of the sequence with both (frame,).
        depth_m: How much nearer the second person is (frame,).
        deviation_m: Its standard deviation (frame,), inf without a pair.
    """

    people: tuple[int, int]
    frames: Integers
    depth_m: Array
    deviation_m: Array


def pair_depths(
    pairs_m: npt.NDArray[np.floating], database: Database, people: Sequence[tuple[Matches, ReconstructedTrack]]
) -> list[PairDepth]:
    """Return the depths between partners by pairs that look like both, in frames that show them near each other.

    Args:
        pairs_m: Pairs (row, person, 14, 3) that have not seen the sequence, as `pairs.centre_pairs` gives them.
        database: Database of the matches, at the pitch of the camera.
        people: Matches and reconstruction of each person.
    """
    number: dict[int | None, int] = {track.person_id: at for at, (_, track) in enumerate(people)}
    partners = [number.get(track.track.partner_id, -1) for _, track in people]
    couples = [(first, second) for first, second in enumerate(partners) if first < second]
    if not couples or not len(pairs_m):
        return []
    pairs = pair_database(pairs_m, num_yaws=database.num_yaws, camera=database.camera)
    index = build_index(pairs)
    depths = [_depth(pairs, index, (people[first], people[second]), (first, second)) for first, second in couples]
    return [depth for depth in depths if depth is not None]


def _depth(
    pairs: Database,
    index: ProjectionIndex,
    couple: Sequence[tuple[Matches, ReconstructedTrack]],
    numbers: tuple[int, int],
) -> PairDepth | None:
    tracks = [track for _, track in couple]
    first, second = (track.track.frames for track in tracks)
    frames = np.intersect1d(first, second)
    at = [frames - track.track.first_frame for track in tracks]
    roots = np.stack([track.root_m[rows] for track, rows in zip(tracks, at, strict=True)], axis=1)
    middle = roots.mean(axis=1)
    distance = np.linalg.norm(middle, axis=-1)
    back = swing_between(-middle / distance[:, None], np.broadcast_to(np.array([0.0, 0.0, 1.0]), middle.shape))
    offset = rotate(np.broadcast_to(back[:, None], (*roots.shape[:2], 4)), roots - middle[:, None])
    is_near = np.hypot(*np.diff(offset[..., :2], axis=1)[:, 0].T) < _MAX_APART_M
    is_near &= ~np.any([track.is_bridged[rows] for track, rows in zip(tracks, at, strict=True)], axis=0)
    if not is_near.any():
        return None
    images, weights = [], []
    for person, (matches, _) in enumerate(couple):
        image = retarget_image(matches.query_m[at[person]], matches.proportions)
        images.append(image + offset[:, person, None, :2])
        weights.append(matches.weights[at[person]])
    depth, deviation = np.zeros(len(frames)), np.full(len(frames), np.inf)
    depth[is_near], deviation[is_near] = _depths_of_images(
        pairs, index, np.stack(images, axis=1)[is_near], np.stack(weights, axis=1)[is_near]
    )
    return PairDepth(numbers, frames, depth, deviation)


def _depths_of_images(pairs: Database, index: ProjectionIndex, query_m: Array, weights: Array) -> tuple[Array, Array]:
    """Return how much nearer person 1 is than person 0 by pairs that look alike, and the standard deviation.

    Args:
        pairs: The pairs, parallel rays.
        index: Their index.
        query_m: Images of both (frame, person, 14, 2), metres about the middle of both mid-hips.
        weights: (frame, person, 14).

    Returns:
        Depth and standard deviation (frame,), metres; the latter is inf where no pair was found.
    """
    matches, is_exchanged = search_pairs(index, query_m, weights, num_neighbours=_NUM_CANDIDATES)
    row, distance = matches.row, matches.distance_m
    turned = pairs.turned(np.maximum(row, 0), matches.yaw_index)
    hips = mid_hip(turned.reshape(*row.shape, 2, OP14.num_joints, 3)) @ pairs.camera.camera_from_upright_rotmat.T
    depth = np.where(is_exchanged, -1.0, 1.0) * (hips[..., 1, 2] - hips[..., 0, 2])
    is_found = np.isfinite(distance[:, 0])
    distance = np.where(is_found[:, None], distance, 0.0)
    share = np.where(row >= 0, np.exp(-(distance - distance[:, :1]) / _MISFIT_M), 0.0)
    share /= np.maximum(share.sum(axis=1, keepdims=True), 1e-300)
    mean = np.sum(share * depth, axis=1)
    spread = np.sqrt(np.sum(share * (depth - mean[:, None]) ** 2, axis=1))
    deviation = np.hypot(spread, _DEVIATION_PER_MISFIT * distance[:, 0])
    return mean, np.where(is_found, np.maximum(deviation, _MIN_DEVIATION_M), np.inf)
