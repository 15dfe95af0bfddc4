"""Two people who move together, placed to each other: by the pairs of a database that look like both.

One camera tells how far away a person is from how large the person looks, so an unknown body size and an unknown lens
both fall on the depth between two people.  A pair of the database that looks like the two of them says how far apart in
depth people stand who are seen so, whatever the lens.  With dz_p(t) from the pairs and dz_o(t) from the two people's
own sizes in the image, D(t) the mean distance from the camera,

    dz_p = g dz_o + c D + noise,

where c is how much larger than thought the first body is than the second (log of the ratio) and g the focal length
over the one assumed, both constant over the video.  They are found by weighted least squares about no change; then both
depths count by their deviations, so where no pair looks alike the people's own sizes decide.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from pydantic import Field

from pasdedeux.kinematics.rotations import rotate, swing_between
from pasdedeux.projections.camera import OrthographicCamera
from pasdedeux.projections.database import Database
from pasdedeux.projections.pairs import pair_database, search_pairs
from pasdedeux.projections.retarget import mid_hip
from pasdedeux.projections.search import ProjectionIndex, build_index
from pasdedeux.reconstruction.proportions import retarget_image
from pasdedeux.reconstruction.reconstruct import Matches, Reconstruction
from pasdedeux.reconstruction.tracks import PersonTrack
from pasdedeux.settings import Settings
from pasdedeux.skeletons import OP14

__all__ = ["PairSearcher", "Placing", "PlacingOptions", "place_couple"]

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]
Couple = tuple[tuple[PersonTrack, Matches, Reconstruction], tuple[PersonTrack, Matches, Reconstruction]]

_KNOWN_LENS_DEVIATION = 0.02
"""Standard deviation of g about 1 where the focal length is stated: lenses breathe by about as much."""
_NUM_ROUNDS = 10


@dataclass(frozen=True)
class PairSearcher:
    """Pairs made ready for search under one pitch, parallel rays."""

    database: Database
    index: ProjectionIndex

    @classmethod
    def of(cls, pairs_m: npt.NDArray[np.floating], *, num_yaws: int, pitch_rad: float) -> PairSearcher:
        """Build the index of pairs (row, person, 14, 3) as `pairs.centre_pairs` gives them."""
        database = pair_database(pairs_m, num_yaws=num_yaws, camera=OrthographicCamera(pitch_rad))
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
    own_deviation_m: float = Field(
        0.15, gt=0, description="Deviation of the depth by the people's own sizes, once c and g are known"
    )
    size_deviation: float = Field(0.1, gt=0, description="Standard deviation of c")
    lens_deviation: float = Field(0.3, gt=0, description="Standard deviation of g about 1")
    apart_s: float = Field(
        0.5, gt=0, description="Frames nearer in time than this count as one: their errors are the same"
    )
    acceleration_m_s2: float = Field(
        3.0, gt=0, description="Standard deviation of the second derivative of the depth between two people"
    )
    max_apart_m: float = Field(
        1.5, gt=0, description="Frames in which the two are further apart in the image are left to their own sizes"
    )


@dataclass(frozen=True)
class Placing:
    """What is done to the two people of a couple, each along the rays through the mid-hip.

    Args:
        frames: Frames of the sequence that both are in (frame,).
        factors: Of the distance of each from the camera (person, frame); held before the first frame and after the
            last.
        sizes: Of the size of each body (person,), product 1.
        lens_factor: g.
    """

    frames: Integers
    factors: Array
    sizes: Array
    lens_factor: float

    def moved(self, number: int, person: PersonTrack, found: Reconstruction) -> Reconstruction:
        """Return the reconstruction of person `number` (0 or 1) of the couple at its place."""
        factor = np.interp(person.frames, self.frames, self.factors[number])
        root = found.root_m * factor[:, None]
        positions = root[:, None] + self.sizes[number] * (found.positions_m - found.root_m[:, None])
        return replace(found, positions_m=positions, root_m=root, metres_per_pixel=found.metres_per_pixel * factor)


def place_couple(searcher: PairSearcher, couple: Couple, options: PlacingOptions | None = None) -> Placing | None:
    """Return the places of two people to each other; None where no frame shows both near each other.

    Args:
        searcher: Pairs that have not seen the sequence, at the pitch of its camera.
        couple: Track, matches and reconstruction of both.
        options: What is believed.
    """
    options = options or PlacingOptions()
    (first, first_matches, first_found), (second, second_matches, second_found) = couple
    if first.track.lens.is_known:
        options = options.model_copy(update={"lens_deviation": min(options.lens_deviation, _KNOWN_LENS_DEVIATION)})
    frames, at = _common(first, second)
    if not len(frames):
        return None
    roots = np.stack([first_found.root_m[at[0]], second_found.root_m[at[1]]], axis=1)
    middle = roots.mean(axis=1)
    distance = np.linalg.norm(middle, axis=-1)
    back = swing_between(-middle / distance[:, None], np.broadcast_to(np.array([0.0, 0.0, 1.0]), middle.shape))
    offset = rotate(np.broadcast_to(back[:, None], (*roots.shape[:2], 4)), roots - middle[:, None])
    own_depth = offset[:, 1, 2] - offset[:, 0, 2]
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
    alike = max(1.0, options.apart_s * first.track.rate_hz)
    lens, size = _fit_constants(own_depth, distance, pair_depth, deviation, alike, options)
    thought = lens * own_depth + size * distance
    precision = np.stack([1.0 / deviation**2, np.full(len(frames), 1.0 / options.own_deviation_m**2)])
    wanted = (precision * np.stack([pair_depth, thought])).sum(axis=0) / precision.sum(axis=0)
    step = options.acceleration_m_s2 / first.track.rate_hz**2
    depth = _smoothed(wanted, precision.sum(axis=0) / alike, 1.0 / step**2)
    return Placing(frames, _factors(offset, distance, depth), np.exp([0.5 * size, -0.5 * size]), lens)


def _common(first: PersonTrack, second: PersonTrack) -> tuple[Integers, list[Integers]]:
    """Return the frames that both tracks span, and where they lie in each."""
    frames = np.intersect1d(first.frames, second.frames)
    return frames, [frames - first.first_frame, frames - second.first_frame]


def _fit_constants(
    own_depth: Array, distance: Array, pair_depth: Array, deviation: Array, alike: float, options: PlacingOptions
) -> tuple[float, float]:
    """Return g and c by least squares, frames that stay off counting less each round (Cauchy's weights)."""
    columns = np.stack([own_depth, distance], axis=1)
    prior = np.diag([1.0 / options.lens_deviation**2, 1.0 / options.size_deviation**2])
    g, c = 1.0, 0.0
    for _ in range(_NUM_ROUNDS):
        off = (pair_depth - columns @ [g, c]) / (2.0 * deviation)
        weight = 1.0 / (alike * deviation**2 * (1.0 + off**2))
        normal = columns.T @ (weight[:, None] * columns) + prior
        g, c = np.linalg.solve(normal, columns.T @ (weight * pair_depth) + prior @ [1.0, 0.0])
    return float(g), float(c)


def _smoothed(values: Array, weights: Array, stiffness: float) -> Array:
    """Return the x of least sum w (x - values)^2 + stiffness (second difference of x)^2 (frame,)."""
    from scipy.linalg import solveh_banded  # here: 0.3 s that planning does not need

    if len(values) < 3:
        return values
    bands = np.zeros((3, len(values)))
    bands[2] += weights
    for offset, factor in ((0, 1.0), (1, 4.0), (2, 1.0)):
        bands[2, offset : len(values) - 2 + offset] += factor * stiffness
    bands[1, 1:-1] -= 2.0 * stiffness
    bands[1, 2:] -= 2.0 * stiffness
    bands[0, 2:] += stiffness
    return np.asarray(solveh_banded(bands, weights * values))


def _factors(offset: Array, distance: Array, depth: Array) -> Array:
    """Return u and 1/u (person, frame), which set the depth between two people who are D_0 and D_1 away.

    D_0 u - D_1 / u = depth, whose positive root keeps the product of the two distances.
    """
    away = distance[:, None] - offset[..., 2]
    u = (depth + np.sqrt(depth**2 + 4.0 * away[:, 0] * away[:, 1])) / (2.0 * away[:, 0])
    return np.stack([u, 1.0 / u])
