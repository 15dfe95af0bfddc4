"""Two people who move together: how far apart in depth the pairs of a database are that look like both.

One camera tells how far away a person is from how large the person looks, so an unknown body size and an unknown lens
both fall on the depth between two people.  A pair of the database that looks like the two of them says how far apart in
depth people stand who are seen so, whatever the lens.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from pydantic import Field

from pasdedeux.arrays import Array
from pasdedeux.kinematics.rotations import rotate, swing_between
from pasdedeux.projections.camera import DatabaseCamera
from pasdedeux.projections.database import Database
from pasdedeux.projections.pairs import pair_database, search_pairs
from pasdedeux.projections.retarget import mid_hip
from pasdedeux.projections.search import ProjectionIndex, build_index
from pasdedeux.reconstruction.proportions import retarget_image
from pasdedeux.reconstruction.reconstruct import Matches, Reconstruction
from pasdedeux.reconstruction.tracks import PersonTrack
from pasdedeux.settings import Settings
from pasdedeux.skeletons import OP14

Integers = npt.NDArray[np.int64]
Couple = tuple[tuple[PersonTrack, Matches, Reconstruction], tuple[PersonTrack, Matches, Reconstruction]]


@dataclass(frozen=True)
class PairSearcher:
    """Pairs made ready for search under one pitch, parallel rays."""

    database: Database
    index: ProjectionIndex

    @classmethod
    def of(cls, pairs_m: npt.NDArray[np.floating], *, num_yaws: int, pitch_rad: float) -> PairSearcher:
        """Build the index of pairs (row, person, 14, 3) as `pairs.centre_pairs` gives them."""
        database = pair_database(pairs_m, num_yaws=num_yaws, camera=DatabaseCamera(pitch_rad))
        return cls(database, build_index(database))

    def depths(self, query_m: Array, weights: Array, options: PlacingOptions) -> tuple[Array, Array]:
        """Return how much nearer person 1 is than person 0 by the pairs that look alike, and the deviation of that.

        Args:
            query_m: Images of both (frame, person, 14, 2), metres about the middle of both mid-hips.
            weights: (frame, person, 14).
            options: How.

        Returns:
            Depth and standard deviation (frame,), metres; the latter is inf where nothing was found.
        """
        found = search_pairs(self.index, query_m, weights, num_neighbours=options.num_candidates)
        row, distance = found.neighbours.row, found.neighbours.distance_m
        turned = self.database.turned(np.maximum(row, 0), found.neighbours.yaw_index)
        hips = (
            mid_hip(turned.reshape(*row.shape, 2, OP14.num_joints, 3))
            @ self.database.camera.camera_from_upright_rotmat.T
        )
        depth = np.where(found.is_exchanged, -1.0, 1.0) * (hips[..., 1, 2] - hips[..., 0, 2])
        is_found = np.isfinite(distance[:, 0])
        distance = np.where(is_found[:, None], distance, 0.0)
        share = np.where(row >= 0, np.exp(-(distance - distance[:, :1]) / options.misfit_m), 0.0)
        share /= np.maximum(share.sum(axis=1, keepdims=True), 1e-300)
        mean = np.sum(share * depth, axis=1)
        spread = np.sqrt(np.sum(share * (depth - mean[:, None]) ** 2, axis=1))
        deviation = np.hypot(spread, options.deviation_per_misfit * distance[:, 0])
        return mean, np.where(is_found, np.maximum(deviation, options.min_deviation_m), np.inf)


class PlacingOptions(Settings):
    """What is believed of the depth between two people."""

    num_candidates: int = Field(20, ge=1, description="Pairs that are looked at per frame")
    misfit_m: float = Field(0.02, gt=0, description="Pairs whose image is this much worse than the best count 1/e")
    deviation_per_misfit: float = Field(
        2.0, gt=0, description="A pair's depth is trusted to this many times the misfit of its image"
    )
    min_deviation_m: float = Field(0.03, gt=0, description="A pair is never trusted better than this")
    max_apart_m: float = Field(
        1.5, gt=0, description="Frames in which the two are further apart in the image are left to their own sizes"
    )


@dataclass(frozen=True)
class PairDepth:
    """What pairs of a database say: how much nearer the second of two people is than the first, along the ray between.

    Args:
        people: Numbers of the two.
        frames: Frames of the sequence that both are in (frame,).
        depth_m: (frame,).
        deviation_m: Standard deviation of it (frame,), inf where nothing is said.
    """

    people: tuple[int, int]
    frames: Integers
    depth_m: Array
    deviation_m: Array


def pair_depths(
    searcher: PairSearcher, couple: Couple, people: tuple[int, int], options: PlacingOptions | None = None
) -> PairDepth | None:
    """Return what pairs say of two people's depth; None where no frame shows both near each other.

    Args:
        searcher: Pairs that have not seen the sequence, at the pitch of its camera.
        couple: Track, matches and reconstruction of both.
        people: Numbers of the two.
        options: What is believed.
    """
    options = options or PlacingOptions()
    (first, first_matches, first_found), (second, second_matches, second_found) = couple
    frames, at = _common(first, second)
    if not len(frames):
        return None
    roots = np.stack([first_found.root_m[at[0]], second_found.root_m[at[1]]], axis=1)
    middle = roots.mean(axis=1)
    distance = np.linalg.norm(middle, axis=-1)
    back = swing_between(-middle / distance[:, None], np.broadcast_to(np.array([0.0, 0.0, 1.0]), middle.shape))
    offset = rotate(np.broadcast_to(back[:, None], (*roots.shape[:2], 4)), roots - middle[:, None])
    is_near = np.hypot(*np.diff(offset[..., :2], axis=1)[:, 0].T) < options.max_apart_m
    is_near &= ~(first_found.is_bridged[at[0]] | second_found.is_bridged[at[1]])
    if not is_near.any():
        return None
    images, weights = [], []
    for number, matches in enumerate((first_matches, second_matches)):
        image = retarget_image(matches.query_m[at[number]], matches.proportions)
        images.append(image + offset[:, number, None, :2])
        weights.append(matches.weights[at[number]])
    pair_depth, deviation = np.zeros(len(frames)), np.full(len(frames), np.inf)
    pair_depth[is_near], deviation[is_near] = searcher.depths(
        np.stack(images, axis=1)[is_near], np.stack(weights, axis=1)[is_near], options
    )
    return PairDepth(people, frames, pair_depth, deviation)


def _common(first: PersonTrack, second: PersonTrack) -> tuple[Integers, list[Integers]]:
    """Return the frames that both tracks span, and where they lie in each."""
    frames = np.intersect1d(first.frames, second.frames)
    return frames, [frames - first.first_frame, frames - second.first_frame]
