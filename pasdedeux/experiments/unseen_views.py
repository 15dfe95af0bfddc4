"""A motion the database does not hold, seen from several directions and reconstructed by every method.

Yiannakides et al. (2019, section 6) compare a reconstruction with the held-out motion it was projected from, and two
reconstructions of one motion from views 75 and 135 degrees apart: on the database's own body by parallel rays, as it
seems the paper did, so that search, choice over time and fit are measured by themselves.  What users have, with
proportions, scale and lens unknown, is measured on virtual videos that stage `reconstruction` sees.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.evaluation.reconstruction_metrics import (
    foot_slide_m,
    jitter_m,
    root_centred_error_m,
    root_removed_error_m,
)
from pasdedeux.evaluation.scores import Score, scores_of
from pasdedeux.evaluation.verdicts import Items
from pasdedeux.fitting.observed_pose import ObservedFitSettings
from pasdedeux.kinematics.rotations import yaw_rotmat
from pasdedeux.projections.retarget import mid_hip, retarget_proportions
from pasdedeux.reconstruction.cleanup import clean_reconstructions
from pasdedeux.reconstruction.live.person import LiveOptions, LivePerson
from pasdedeux.reconstruction.pitch import floor_offset
from pasdedeux.reconstruction.reconstruct import (
    Matches,
    Method,
    ReconstructionOptions,
    Searcher,
    match_track,
    reconstruct_track,
)
from pasdedeux.reconstruction.tracks import Lens, Track
from pasdedeux.skeletons import OP14

Stream = Callable[[int], np.random.Generator]

BEST_MARK = "best_of_50"
LIVE = "live"
"""Frame by frame, each pose a few frames after its image."""
CLEAN = "_clean"
"""Appended to the name of a method whose motion was cleaned up."""
ALL_VIEWS = "mean of views"

_PIXELS_PER_METRE = 1000.0
_FAR_PX = 1e9
"""Focal length of a lens whose rays are parallel to one part in a million."""

_KNOWN_BODY = ReconstructionOptions(
    has_own_proportions=False,
    metres_per_pixel=1.0 / _PIXELS_PER_METRE,
    fit=ObservedFitSettings(min_noise_m=0.001),
    trust_per_misfit=4.0,
)
"""Proportions, scale and lens are right, so the image is believed to 1 mm, and retrieved bones half as tightly.

Chosen on clips of a database left out in turn; where scale or proportions are estimated, the second makes the
fit worse.
"""


@dataclass(frozen=True)
class Condition:
    """What is done to the image.

    Args:
        name: For the tables.
        noise: Standard deviation of each coordinate's noise, as a part of the length of the torso.
        missing: Share of the joints hidden, each on its own.
    """

    name: str
    noise: float = 0.0
    missing: float = 0.0


CONDITIONS = (
    Condition("clean"),
    Condition("noise 3 % of the torso", noise=0.03),
    Condition("30 % of the joints missing", missing=0.3),
)


@dataclass(frozen=True)
class UnseenMotion:
    """A motion that a database has not seen.

    Args:
        item: Name, for the tables.
        world_m: The motion (frame, 14, 3), upright axes, floor at 0, its own proportions and root path, metres.
        rate_hz: Its rate.
        yaws_deg: Directions it is seen from; each later one is also compared with the first.
    """

    item: str
    world_m: Array
    rate_hz: float
    yaws_deg: Sequence[float]


@dataclass(frozen=True)
class ViewedMotion:
    """A motion as a camera sees it.

    Args:
        track: The keypoints.
        truth_m: The motion (frame, 14, 3), camera axes, metres.
    """

    track: Track
    truth_m: Array


def see(motion: UnseenMotion, condition: Condition, yaw_deg: float, rng: np.random.Generator) -> ViewedMotion:
    """Return what parallel rays `yaw_deg` about +Y see of a motion; the generator draws noise and hidden joints.

    The motion is put on the database's body first, its root path kept.
    """
    shape = motion.world_m.shape[:2]
    noise = rng.normal(0.0, 1.0, (*shape, 2)) * condition.noise
    hidden = rng.uniform(size=shape) < condition.missing
    body = retarget_proportions(motion.world_m)
    torso = float(np.median(np.linalg.norm(body[:, OP14.root] - mid_hip(body), axis=-1)))
    truth = np.asarray((body - mid_hip(body).mean(axis=0)) @ yaw_rotmat(np.deg2rad(yaw_deg)).T)
    px = _PIXELS_PER_METRE * (truth[..., :2] * np.array([1.0, -1.0]) + noise * torso)
    px[hidden] = np.nan
    return ViewedMotion(Track(px, np.where(hidden, 0.0, 1.0), motion.rate_hz, Lens(_FAR_PX, (0.0, 0.0))), truth)


def best_candidates(searcher: Searcher, found: Matches, truth_m: Array) -> Array:
    """Return for each frame the candidate (frame, 14, 3) nearest to the truth (frame, 14, 3): a mark, not a method.

    Candidates are on the reference body.  Frames without candidates have NaN.
    """
    neighbours = found.neighbours
    poses = searcher.database.turned(np.maximum(neighbours.row, 0), found.yaw_steps)
    poses = np.einsum("ij,...nj->...ni", searcher.database.camera.camera_from_upright_rotmat, poses)
    centred = truth_m - mid_hip(truth_m)[:, None]
    error = np.linalg.norm(poses - centred[:, None], axis=-1).mean(axis=-1)
    error[neighbours.projection < 0] = np.inf
    best = np.take_along_axis(poses, np.argmin(error, axis=1)[:, None, None, None], axis=1)[:, 0]
    best[~np.isfinite(error).any(axis=1)] = np.nan
    return np.asarray(best)


def reconstruct_seen(searcher: Searcher, seen: ViewedMotion, *, has_clean_up: bool) -> dict[str, Array]:
    """Return a motion (frame, 14, 3) in camera axes by method; the database of the searcher has not seen it.

    With `has_clean_up` also what the clean-up makes of each, and the live chain with and without.
    """
    camera = searcher.database.camera
    track = seen.track
    found = match_track(searcher, track, _KNOWN_BODY)
    made = {method.value: reconstruct_track(searcher, track, method, _KNOWN_BODY, matches=found) for method in Method}
    motions = {BEST_MARK: best_candidates(searcher, found, seen.truth_m)}
    motions |= {name: one.positions_m for name, one in made.items()}
    if not has_clean_up:
        return motions
    for name, one in made.items():
        (cleaned,) = clean_reconstructions([one], floor_offset([one], camera), camera)
        motions[name + CLEAN] = cleaned.positions_m
    motions[LIVE] = _live_motion(searcher, track, has_clean_up=False)
    motions[LIVE + CLEAN] = _live_motion(searcher, track, has_clean_up=True)
    return motions


def _live_motion(searcher: Searcher, track: Track, *, has_clean_up: bool) -> Array:
    """Return a motion (frame, 14, 3) in camera axes as it leaves the live chain; NaN in frames without a pose."""
    live = LiveOptions(
        metres_per_pixel=_KNOWN_BODY.metres_per_pixel,
        has_own_proportions=False,
        has_clean_up=has_clean_up,
        min_noise_m=_KNOWN_BODY.fit.min_noise_m,
    )
    person = LivePerson(0, searcher, rate_hz=track.rate_hz, lens=track.lens, options=live)
    poses = []
    for frame, (points, confidence) in enumerate(zip(track.keypoints_px, track.confidence, strict=True)):
        poses += person.push(frame, points, confidence)
    motion = np.full((*track.confidence.shape, 3), np.nan)
    for pose in [*poses, *person.finish()]:
        motion[pose.frame] = pose.positions_m
    return motion


def unseen_view_scores(
    searcher: Searcher, motion: UnseenMotion, condition: Condition, stream: Stream
) -> tuple[list[Score], Items]:
    """Score every method on a motion seen from several directions, and how far its reconstructions differ.

    The items are the errors of all poses, the root kept.

    The database has not seen the motion and is of a level camera; `stream` gives the random stream of a view.
    """
    figures: dict[tuple[str, str], list[float]] = {}
    motions: dict[str, list[Array]] = {}
    parts: list[Items] = []
    for view, yaw in enumerate(motion.yaws_deg):
        seen = see(motion, condition, yaw, stream(view))
        errors: dict[str, Array] = {}
        times_s = np.arange(len(seen.truth_m)) / motion.rate_hz
        for method, positions in reconstruct_seen(searcher, seen, has_clean_up=True).items():
            errors[method] = root_centred_error_m(positions, seen.truth_m)
            motions.setdefault(method, []).append(positions)
            slide_hz = motion.rate_hz if method != BEST_MARK else None
            for metric, value in _figures(positions, seen.truth_m, rate_hz=slide_hz).items():
                figures.setdefault((metric, method), []).append(value)
        parts.append(Items(errors, [motion.item] * len(times_s), times_s, (Method.NEAREST.value,)))
        for metric in ("jitter", "foot_slide"):
            value = _figures(seen.truth_m, seen.truth_m, rate_hz=motion.rate_hz)[metric]
            figures.setdefault((metric, "truth"), []).append(value)
    item, count = motion.item, len(motion.world_m)
    scores = []
    for (metric, method), values in figures.items():
        named = [(f"{item} at {yaw:g} degrees", value) for yaw, value in zip(motion.yaws_deg, values, strict=True)]
        named += [(f"{item}, {ALL_VIEWS}", float(np.mean(values)))] if len(values) > 1 else []
        scores += [
            Score(metric, method, value, "m", _is_baseline(method), condition.name, label, count=count)
            for label, value in named
        ]
    for method, found in motions.items():
        for yaw, other in zip(motion.yaws_deg[1:], found[1:], strict=True):
            differs = {"two_views_differ": _mean(root_removed_error_m(found[0], other))}
            label = f"{item}, views {abs(yaw - motion.yaws_deg[0]):g} degrees apart"
            more = {"is_baseline": _is_baseline(method), "split": condition.name, "item": label, "count": count}
            scores += scores_of(differs, method, "m", **more)
    return scores, Items.joined(parts)


def _figures(found: Array, truth: Array, *, rate_hz: float | None) -> dict[str, float]:
    """Return errors of a motion, and how far its feet slide where a rate is given (its trajectory must be known)."""
    known = found[np.isfinite(found).all(axis=(1, 2))]
    centred = known - mid_hip(known)[:, None]
    figures = {
        "error_root_kept": _mean(root_centred_error_m(found, truth)),
        "error_root_removed": _mean(root_removed_error_m(found, truth)),
        "jitter": jitter_m(centred),
    }
    return figures if rate_hz is None else {**figures, "foot_slide": foot_slide_m(found, truth, rate_hz=rate_hz)}


def _mean(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else float("nan")


def _is_baseline(method: str) -> bool:
    return method.removesuffix(CLEAN) in (Method.NEAREST.value, BEST_MARK, "truth")
