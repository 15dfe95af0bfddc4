"""A motion the database does not hold, on the database's body and by parallel rays, as the paper's own tables have it.

Yiannakides et al. (2019, section 6) compare a reconstruction with the held-out motion it was projected from, and two
reconstructions of one motion from views 75 and 135 degrees apart.  Proportions and scale are known here, so the figures
say what search, choice over time and fit are worth by themselves; what users have is the topic `reconstruction`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from pasdedeux.evaluation.reconstruction_metrics import jitter_m, root_centred_error_m, root_removed_error_m
from pasdedeux.evaluation.scores import Score
from pasdedeux.fitting.observed_pose import ObservedFitSettings
from pasdedeux.kinematics.rotations import yaw_rotmat
from pasdedeux.projections.published import Codebook, recall, search_published
from pasdedeux.projections.reconstruct import (
    Matches,
    Method,
    ReconstructionOptions,
    Searcher,
    match_track,
    reconstruct_track,
)
from pasdedeux.projections.retarget import mid_hip, retarget_proportions
from pasdedeux.projections.tracks import Lens, Track
from pasdedeux.skeletons import OP14

__all__ = ["CONDITIONS", "Condition", "best_candidates", "parallel_track", "parallel_view_scores"]

Array = npt.NDArray[np.float64]

TOPIC = "parallel_views"
BEST_MARK = "best_of_50"
AS_PUBLISHED = "as_published"
_PIXELS_PER_METRE = 1000.0
_FAR_PX = 1e9
"""Focal length of a lens whose rays are parallel to one part in a million."""

_KNOWN_BODY = ReconstructionOptions(
    has_own_proportions=False,
    metres_per_pixel=1.0 / _PIXELS_PER_METRE,
    fit=ObservedFitSettings(least_noise_m=0.002),
)
"""Proportions, scale and lens are right, so the image is believed to 2 mm."""


@dataclass(frozen=True)
class Condition:
    """What is done to the image.

    Args:
        name: For the tables.
        noise: Standard deviation of each coordinate's noise, as a part of the length of the torso.
        missing: Share of the joints hidden, each on its own.
        has_scale: Metres per pixel are known; estimated from the track otherwise.
    """

    name: str
    noise: float = 0.0
    missing: float = 0.0
    has_scale: bool = True

    @property
    def options(self) -> ReconstructionOptions:
        """How its tracks are reconstructed."""
        return _KNOWN_BODY if self.has_scale else replace(_KNOWN_BODY, metres_per_pixel=None)


CONDITIONS = (
    Condition("clean"),
    Condition("noise 3 % of the torso", noise=0.03),
    Condition("30 % of the joints missing", missing=0.3),
    Condition("clean, scale estimated", has_scale=False),
)


def parallel_track(poses_m: Array, rate_hz: float, condition: Condition, rng: np.random.Generator) -> Track:
    """Give the track of poses (frame, 14, 3), camera axes, by parallel rays."""
    torso = float(np.median(np.linalg.norm(poses_m[:, OP14.root] - mid_hip(poses_m), axis=-1)))
    points = poses_m[..., :2] + rng.normal(0.0, 1.0, (*poses_m.shape[:2], 2)) * condition.noise * torso
    hidden = rng.uniform(size=poses_m.shape[:2]) < condition.missing
    px = np.where(hidden[..., None], np.nan, points * np.array([_PIXELS_PER_METRE, -_PIXELS_PER_METRE]))
    return Track(px, np.where(hidden, 0.0, 1.0), rate_hz, Lens(_FAR_PX, (0.0, 0.0)))


def best_candidates(searcher: Searcher, found: Matches, truth_m: Array) -> Array:
    """Give for each frame the candidate (frame, 14, 3) nearest to the truth (frame, 14, 3): a mark, not a method.

    Frames without candidates have NaN.
    """
    neighbours = found.neighbours
    poses = searcher.database.turned(np.maximum(neighbours.row, 0), neighbours.yaw_index)
    poses = np.einsum("ij,...nj->...ni", searcher.database.camera.camera_from_upright_rotmat, poses)
    centred = truth_m - mid_hip(truth_m)[:, None]
    error = np.linalg.norm(poses - centred[:, None], axis=-1).mean(axis=-1)
    error[neighbours.projection < 0] = np.inf
    best = np.take_along_axis(poses, np.argmin(error, axis=1)[:, None, None, None], axis=1)[:, 0]
    best[~np.isfinite(error).any(axis=1)] = np.nan
    return np.asarray(best)


def parallel_view_scores(
    searcher: Searcher,
    world_m: Array,
    *,
    rate_hz: float,
    item: str,
    yaws_deg: Sequence[float],
    stream: Callable[[int, int], np.random.Generator],
    conditions: Sequence[Condition] = CONDITIONS,
    codebook: Codebook | None = None,
) -> list[Score]:
    """Score every method on a motion seen from several directions, and how far its reconstructions differ.

    Args:
        searcher: Database that has not seen the motion, level orthographic camera.
        world_m: The motion (frame, 14, 3), upright axes, any proportions.
        rate_hz: Its rate.
        item: Name of the motion, for the table.
        yaws_deg: Directions it is seen from; each later one is also compared with the first.
        stream: Gives the random stream of a (condition, view).
        conditions: What is done to the images.
        codebook: Clusters of the database: the published search and the window rule are then scored too.
    """
    body = retarget_proportions(world_m)
    body = body - mid_hip(body)[:, None]
    scores: list[Score] = []
    for number, condition in enumerate(conditions):
        made: dict[str, list[Array]] = {}
        for view, yaw in enumerate(yaws_deg):
            truth = np.asarray(body @ yaw_rotmat(np.deg2rad(yaw)).T)
            track = parallel_track(truth, rate_hz, condition, stream(number, view))
            found = match_track(searcher, track, condition.options)
            results = {BEST_MARK: best_candidates(searcher, found, truth)}
            for method in Method:
                one = reconstruct_track(searcher, track, method, condition.options, matches=found)
                results[method.value] = one.positions_m - one.root_m[:, None]
            if codebook is not None:
                published = search_published(searcher.database, codebook, found.query_m, found.weights)
                one = reconstruct_track(
                    searcher, track, Method.WINDOW, condition.options, matches=replace(found, neighbours=published)
                )
                results[AS_PUBLISHED] = one.positions_m - one.root_m[:, None]
                for num_best in (1, 50):
                    share = recall(published, found.neighbours, num_best=num_best)
                    label = f"{item} at {yaw:g} degrees"
                    metric = f"recall_at_{num_best}"
                    scores.append(
                        Score(TOPIC, metric, AS_PUBLISHED, share, "", False, condition.name, label, count=len(truth))
                    )
            for method_name, positions in results.items():
                scores += _errors(method_name, positions, truth, condition.name, f"{item} at {yaw:g} degrees")
                made.setdefault(method_name, []).append(positions)
            scores.append(
                _score("jitter", "truth", jitter_m(truth), condition.name, f"{item} at {yaw:g} degrees", len(truth))
            )
        for method_name, motions in made.items():
            for yaw, other in zip(yaws_deg[1:], motions[1:], strict=True):
                differs = _mean(root_removed_error_m(motions[0], other))
                label = f"{item}, views {abs(yaw - yaws_deg[0]):g} degrees apart"
                scores.append(_score("two_views_differ", method_name, differs, condition.name, label, len(body)))
    return scores


def _errors(method: str, found: Array, truth: Array, split: str, item: str) -> list[Score]:
    figures = {
        "error_root_kept": _mean(root_centred_error_m(found, truth)),
        "error_root_removed": _mean(root_removed_error_m(found, truth)),
        "jitter": jitter_m(found[np.isfinite(found).all(axis=(1, 2))]),
    }
    return [_score(metric, method, value, split, item, len(truth)) for metric, value in figures.items()]


def _mean(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else float("nan")


def _score(metric: str, method: str, value: float, split: str, item: str, count: int) -> Score:
    is_baseline = method in (Method.NEAREST.value, BEST_MARK, AS_PUBLISHED, "truth")
    return Score(TOPIC, metric, method, value, "m", is_baseline, split, item, count=count)
