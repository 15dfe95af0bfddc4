"""A motion that the database lacks, seen from several directions and reconstructed by every method.

Yiannakides et al. (2019, section 6) compare a reconstruction with the held-out motion from which it was projected, and
two reconstructions of one motion from views 75 and 135 degrees apart.  We use the body of the database and parallel
rays, as the paper seems to do, to measure search, selection over time and fit alone.  Topic `reconstruction` covers
unknown proportions, scale and lens.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.kinematics.rotations import yaw_rotmat
from pasdedeux.projections.retarget import mid_hip, retarget_proportions
from pasdedeux.reconstruction.cleanup import clean_reconstructions
from pasdedeux.reconstruction.live.person import LiveOptions, LivePerson
from pasdedeux.reconstruction.matching import Matches, ReconstructionOptions, Searcher, match_track
from pasdedeux.reconstruction.pitch import floor_offset
from pasdedeux.reconstruction.reconstruct import reconstruct_track
from pasdedeux.reconstruction.tracks import Lens, Track
from pasdedeux.skeletons import OP14

BEST = "best_of_50"
STILL = "standing_still"
"""The mean true pose of the motion in every frame: its error shows how much the person moves."""
LIVE = "live"
"""Live reconstruction: each pose a few frames after its image."""
CLEAN = "_clean"
"""Suffix of methods after the clean-up."""

_PIXELS_PER_METRE = 1000.0
_FAR_PX = 1e9
"""Focal length that makes rays parallel to one part in a million."""

_KNOWN_BODY = ReconstructionOptions(
    has_own_proportions=False, metres_per_pixel=1.0 / _PIXELS_PER_METRE, min_noise_m=0.001, trust_per_misfit=4.0
)
"""Settings for exact proportions, scale and lens: the image is trusted to 1 mm, and retrieved bones half as tightly.

Chosen by leave-one-out on clips of a database; if scale or proportions are estimated, the second makes the fit worse.
"""


@dataclass(frozen=True)
class Condition:
    """A condition of the image.

    Args:
        name: Name for the tables.
        noise: Standard deviation of each coordinate's noise, as a part of the length of the torso.
        missing: Share of joints that are hidden, independently.
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
    """A motion that a database lacks.

    Args:
        item: Name for the tables.
        world_m: The motion (frame, 14, 3), upright axes, floor at 0, its own proportions and root path, metres.
        rate_hz: Frames per second.
        yaws_deg: Directions of the views; each later one is also compared with the first.
    """

    item: str
    world_m: Array
    rate_hz: float
    yaws_deg: Sequence[float]


@dataclass(frozen=True)
class ViewedMotion:
    """A motion seen by a camera.

    Args:
        track: The keypoints.
        truth_m: The motion (frame, 14, 3), camera axes, metres.
    """

    track: Track
    truth_m: Array


def see(motion: UnseenMotion, condition: Condition, yaw_deg: float, rng: np.random.Generator) -> ViewedMotion:
    """Return a motion as parallel rays `yaw_deg` about +Y see it; the generator draws noise and hidden joints.

    The motion is retargeted to the database's body first; its root path is kept.
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


def best_candidates(searcher: Searcher, matches: Matches, truth_m: Array) -> Array:
    """Return the candidate of each frame nearest to the ground truth (frame, 14, 3): a bound, not a method.

    Candidates are on the reference body.  Frames without candidates have NaN.
    """
    neighbours = matches.neighbours
    poses = searcher.database.turned(np.maximum(neighbours.row, 0), matches.yaw_steps)
    poses = np.einsum("ij,...nj->...ni", searcher.database.camera.camera_from_upright_rotmat, poses)
    centred = truth_m - mid_hip(truth_m)[:, None]
    error = np.linalg.norm(poses - centred[:, None], axis=-1).mean(axis=-1)
    error[neighbours.projection < 0] = np.inf
    best = np.take_along_axis(poses, np.argmin(error, axis=1)[:, None, None, None], axis=1)[:, 0]
    best[~np.isfinite(error).any(axis=1)] = np.nan
    return np.asarray(best)


def reconstruct_seen(searcher: Searcher, seen: ViewedMotion, *, has_clean_up: bool) -> dict[str, Array]:
    """Return the motion (frame, 14, 3) by each method, camera axes; the database must lack it.

    With `has_clean_up`, also each after the clean-up, and the live chain with and without clean-up.
    """
    camera = searcher.database.camera
    track = seen.track
    matches = match_track(searcher, track, _KNOWN_BODY)
    tracks = {
        method.value: reconstruct_track(searcher, track, method, _KNOWN_BODY, matches=matches)
        for method in searcher.methods
    }
    centred = seen.truth_m - mid_hip(seen.truth_m)[:, None]
    motions = {
        BEST: best_candidates(searcher, matches, seen.truth_m),
        STILL: np.broadcast_to(centred.mean(axis=0), centred.shape),
    }
    motions |= {name: reconstructed.positions_m for name, reconstructed in tracks.items()}
    if not has_clean_up:
        return motions
    for name, reconstructed in tracks.items():
        (cleaned,) = clean_reconstructions([reconstructed], floor_offset([reconstructed], camera), camera)
        motions[name + CLEAN] = cleaned.positions_m
    motions[LIVE] = _live_motion(searcher, track, has_clean_up=False)
    motions[LIVE + CLEAN] = _live_motion(searcher, track, has_clean_up=True)
    return motions


def _live_motion(searcher: Searcher, track: Track, *, has_clean_up: bool) -> Array:
    """Return the motion (frame, 14, 3) by the live chain, camera axes; NaN in frames without a pose."""
    live = LiveOptions(
        metres_per_pixel=_KNOWN_BODY.metres_per_pixel,
        has_own_proportions=False,
        has_clean_up=has_clean_up,
        min_noise_m=_KNOWN_BODY.min_noise_m,
    )
    person = LivePerson(0, searcher, rate_hz=track.rate_hz, lens=track.lens, options=live)
    poses = []
    for frame, (points, confidence) in enumerate(zip(track.keypoints_px, track.confidence, strict=True)):
        poses += person.push(frame, points, confidence)
    motion = np.full((*track.confidence.shape, 3), np.nan)
    for pose in [*poses, *person.finish()]:
        motion[pose.frame] = pose.positions_m
    return motion
