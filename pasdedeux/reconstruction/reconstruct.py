"""Make a 3D motion of the candidates of a track: choose over time, fill gaps, smooth, fit, place before the camera."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array, Flags, Integers, interpolate
from pasdedeux.errors import InputError
from pasdedeux.fitting.observed_pose import fit_observed, flatten_image, image_noise
from pasdedeux.kinematics.rotations import rotate, swing_between
from pasdedeux.projections.database import Database
from pasdedeux.projections.retarget import REFERENCE_LENGTHS_M, mid_hip
from pasdedeux.projections.scale import Placement
from pasdedeux.reconstruction.bones import bone_rotations, place_bone_rotations
from pasdedeux.reconstruction.depth import bone_vectors, decode_depths, place_depths
from pasdedeux.reconstruction.errors import root_centred_error_m
from pasdedeux.reconstruction.matching import Matches, Method, ReconstructionOptions, Searcher, match_track, odd_window
from pasdedeux.reconstruction.proportions import retarget_image
from pasdedeux.reconstruction.rays import camera_turns
from pasdedeux.reconstruction.smoothing import bridge_gaps, smooth_savitzky_golay
from pasdedeux.reconstruction.temporal import choose_nearest, choose_viterbi, choose_window
from pasdedeux.reconstruction.tracks import Track
from pasdedeux.skeletons import OP14

SMOOTHING_S = 0.375
"""Window of the Savitzky-Golay smoothing."""
_SMOOTHING_ORDER = 2
_SMOOTHED_NOISE = 0.6
"""Share of the noise that a Savitzky-Golay window of 7 frames and order 2 leaves."""

_NUM_FIT_ROUNDS = 2
_SAME_IMAGE_M = 0.002
"""The fit makes a second round if the depths of the first change the image by more than this."""

_BONE_DEVIATION_RANGE_M = (0.01, 0.2)
"""Range of the standard deviation of a retrieved bone."""

_NOISE_OF_EQUAL_SHARES_M = 0.03
"""Noise of the image at which the motion chosen over time and the candidates of a frame have equal weight."""

MEAN_OF_RAYLEIGH = float(np.sqrt(np.pi / 2.0))
"""Mean error of a point in the image, over the standard deviation of each coordinate."""

_BRIDGED_MISFIT_M = 0.05
"""Misfit assumed for interpolated frames."""

HOW_TO_CLUSTER = "method 'published' needs them: set num_clusters (500 in the paper) of [projections]"


@dataclass(frozen=True)
class ReconstructedTrack:
    """A reconstructed track, camera axes (x right, y up, z towards the camera), camera at the origin, metres.

    Args:
        track: The keypoints.
        positions_m: op14 positions (frame, 14, 3).
        root_m: Mid-hip (frame, 3).
        yaw_rad: Yaw of the matched projection (frame,); NaN where interpolated.
        score_m: Mean distance of the seen joints from it (frame,); NaN where interpolated.
        row: Matched row of the database (frame,); -1 where interpolated.
        is_bridged: Whether the pose is interpolated because the frame shows too little (frame,).
        metres_per_pixel: (frame,).
        correction_m: Mean distance by which the fit moved the joints of the chosen poses (frame,), mid-hips aligned;
            NaN without a fit.
        noise_m: Standard deviation of the image's noise.
    """

    track: Track
    positions_m: Array
    root_m: Array
    yaw_rad: Array
    score_m: Array
    row: Integers
    is_bridged: Flags
    metres_per_pixel: Array
    correction_m: Array
    noise_m: float

    @cached_property
    def bone_unitquat(self) -> Array:
        """Rotations of the bones (frame, 14, 4), see `bones.bone_rotations`."""
        return bone_rotations(self.positions_m)

    @property
    def person_id(self) -> int:
        """Person in the sequence."""
        return self.track.person_id

    @property
    def num_joints_seen(self) -> Integers:
        """Number of joints seen in each frame (frame,)."""
        return np.asarray((self.track.confidence > 0).sum(axis=1))

    def posed(self, positions_m: Array) -> ReconstructedTrack:
        """Return the track with other positions (frame, 14, 3)."""
        return replace(self, positions_m=positions_m, root_m=mid_hip(positions_m))

    def scaled(self, size: float) -> ReconstructedTrack:
        """Return the track with body and path scaled about the camera, which leaves the image as it is."""
        return replace(
            self,
            positions_m=size * self.positions_m,
            root_m=size * self.root_m,
            metres_per_pixel=size * self.metres_per_pixel,
        )


def reconstruct_track(
    searcher: Searcher,
    track: Track,
    method: Method = Method.VITERBI,
    options: ReconstructionOptions | None = None,
    *,
    matches: Matches | None = None,
) -> ReconstructedTrack:
    """Return a track's motion before the camera.

    Args:
        searcher: Prepared database.
        track: The keypoints.
        method: `nearest` takes each frame's best match as it is (the baseline); `window` and `viterbi` choose over time
            and are smoothed (Savitzky-Golay on the bones' rotations, which keeps bone lengths); `published` is
            `window` over the results of the published search, on the database's body; `fit` also fits `viterbi` to the
            image.
        options: Settings.
        matches: Result of `match_track` for this track, if it is known.

    Raises:
        InputError: Nothing to search for; see `match_track`.  Or the method is `published` and the database has no
            clusters.
    """
    options = options or ReconstructionOptions()
    matches = matches or match_track(searcher, track, options)
    if method is Method.PUBLISHED:
        matches = _published_matches(searcher, matches)
    database, neighbours = searcher.database, matches.neighbours
    if method is Method.NEAREST:
        ranks = choose_nearest(neighbours)
    elif method in (Method.WINDOW, Method.PUBLISHED):
        ranks = choose_window(database, neighbours, yaw_steps=matches.yaw_steps)
    else:
        ranks = choose_viterbi(database, neighbours, rate_hz=track.rate_hz, yaw_steps=matches.yaw_steps)
    is_known = ranks >= 0
    frames = np.arange(len(ranks))
    rank = np.maximum(ranks, 0)
    row = np.where(is_known, neighbours.row[frames, rank], -1)
    yaw_steps = matches.yaw_steps[frames, rank]
    unitquat = bridge_gaps(bone_rotations(_before_camera(database, np.maximum(row, 0), yaw_steps)), is_known)
    if method is not Method.NEAREST:
        unitquat = smooth_savitzky_golay(unitquat, num_frames=odd_window(SMOOTHING_S, track.rate_hz))
    lengths = REFERENCE_LENGTHS_M * matches.proportions
    relative = place_bone_rotations(unitquat, lengths, np.zeros((len(ranks), 3)))
    placement, retrieved = matches.placement, relative
    if method is Method.FIT:
        relative = _fit(searcher, matches, relative, is_known, track, options)
    root, towards = _root_before_camera(placement, matches.towards_camera, track, is_known)
    if method is not Method.NEAREST:
        root = _smooth_path(root, odd_window(SMOOTHING_S, track.rate_hz))
    positions = rotate(camera_turns(towards)[:, None], relative) + root[:, None]
    return ReconstructedTrack(
        track=track,
        positions_m=positions,
        root_m=mid_hip(positions),
        yaw_rad=np.where(is_known, yaw_steps * database.yaw_step_rad, np.nan),
        score_m=np.where(is_known, neighbours.distance_m[frames, rank], np.nan),
        row=row if searcher.source_row is None else np.where(is_known, searcher.source_row[row], -1),
        is_bridged=~is_known,
        metres_per_pixel=placement.metres_per_pixel,
        correction_m=root_centred_error_m(relative, retrieved) if method is Method.FIT else np.full(len(ranks), np.nan),
        noise_m=image_noise(matches.query_m, matches.weights > 0),
    )


def _published_matches(searcher: Searcher, matches: Matches) -> Matches:
    """Return the matches of the published search, which keeps yaws and proportions of the database.

    Raises:
        InputError: The database has no clusters.
    """
    if searcher.published is None:
        raise InputError(f"the projection database has no clusters; {HOW_TO_CLUSTER}")
    hips = mid_hip(matches.query_m)
    about_hips = matches.query_m - np.where(np.isfinite(hips), hips, 0.0)[:, None]
    neighbours = searcher.published.search(about_hips, matches.weights)
    return replace(
        matches,
        neighbours=neighbours,
        proportions=np.ones(OP14.num_joints),
        yaw_steps=neighbours.yaw_index.astype(np.float64),
    )


def _fit(
    searcher: Searcher, matches: Matches, matched: Array, is_known: Flags, track: Track, options: ReconstructionOptions
) -> Array:
    """Return matched poses (frame, 14, 3), mid-hip at the origin, fitted to the image with the person's own bones.

    Candidates vote on depths in reference proportions; the fit uses the person's own.  Removing perspective from the
    image needs the depths, which follow from that image, so a second round starts from the depths of the first.  Bones
    are drawn to the mean of the candidates with the same sign of depth.  In a noisy image these votes change from frame
    to frame, and bones are drawn more to the motion chosen over time.
    """
    neighbours = matches.neighbours
    reference = place_bone_rotations(bone_rotations(matched), REFERENCE_LENGTHS_M, np.zeros((len(matched), 3)))
    distance = matches.placement.metres_per_pixel * track.lens.focal_px
    is_seen = matches.weights > 0
    noise = image_noise(matches.query_m, is_seen)
    match_m = np.where(is_known, neighbours.distance_m[:, 0], np.hypot(_BRIDGED_MISFIT_M, MEAN_OF_RAYLEIGH * noise))
    trust = bone_deviation_m(match_m, noise, options.trust_per_misfit)[:, None] * np.ones(OP14.num_joints)
    window = odd_window(0.5 * SMOOTHING_S, track.rate_hz)
    positions = matched
    candidates = _before_camera(searcher.database, np.maximum(neighbours.row, 0), matches.yaw_steps)
    candidates[~is_known] = reference[~is_known, None]
    misfit = np.where(is_known[:, None], neighbours.distance_m, 0.0)
    misfit = misfit - misfit[:, :1]
    followed = bone_vectors(matched)
    share = share_of_followed(noise)
    flat = np.full(matches.query_m.shape, np.inf)
    for _ in range(_NUM_FIT_ROUNDS):
        before, flat = flat, flatten_image(matches.query_m, positions, distance)
        if np.abs(flat - before)[is_seen].max() < _SAME_IMAGE_M:
            break
        observed = retarget_image(_smooth_seen(flat, is_seen, window), matches.proportions)
        left = max(_SMOOTHED_NOISE * noise, options.min_noise_m)
        vectors, depths = decode_depths(observed, candidates, misfit, noise_m=left, rate_hz=track.rate_hz)
        start = place_depths(np.where(is_seen[..., None], flat, matched[..., :2]), depths * matches.proportions)
        start[..., 2] -= mid_hip(start)[:, None, 2]
        positions = fit_observed(
            OP14,
            REFERENCE_LENGTHS_M * matches.proportions,
            start,
            matches.query_m,
            matches.weights,
            share * followed + (1.0 - share) * vectors * matches.proportions[:, None],
            trust,
            rate_hz=track.rate_hz,
            distance_m=distance,
            min_noise_m=options.min_noise_m,
        )
        positions = positions - mid_hip(positions)[:, None]
    return positions


def bone_deviation_m(match_m: npt.ArrayLike, noise_m: float, per_misfit: float) -> Array:
    """Return the standard deviation (*batch,) of bones of matches with a misfit (*batch,), metres.

    The noise of the image is subtracted from the misfit, because it does not make a match worse.
    """
    misfit = np.sqrt(np.maximum(np.asarray(match_m) ** 2 - (MEAN_OF_RAYLEIGH * noise_m) ** 2, 0.0))
    return np.clip(per_misfit * misfit, *_BONE_DEVIATION_RANGE_M)


def share_of_followed(noise_m: float) -> float:
    """Return the weight, 0 to 1, of the motion chosen over time against the frame's own candidates."""
    return noise_m**2 / (noise_m**2 + _NOISE_OF_EQUAL_SHARES_M**2)


def _before_camera(database: Database, row: Integers, yaw_steps: Array) -> Array:
    """Return database poses (*batch, 14, 3) at these yaws in the axes of the database's camera."""
    turned = database.turned(row, yaw_steps)
    return np.asarray(np.einsum("ij,...nj->...ni", database.camera.camera_from_upright_rotmat, turned))


def _smooth_path(path: Array, window: int) -> Array:
    """Smooth points over time (frame, d)."""
    length = min(window, len(path) - (len(path) + 1) % 2)
    if length <= _SMOOTHING_ORDER:
        return path
    from scipy.signal import savgol_filter  # here: 0.3 s that planning does not need

    return np.asarray(savgol_filter(path, length, _SMOOTHING_ORDER, axis=0))


def _smooth_seen(points: Array, is_seen: Flags, window: int) -> Array:
    """Smooth each joint's path (frame, 14, 2) over time across its gaps; NaN stays where it was not seen."""
    frames = np.arange(len(points))
    smooth = np.full(points.shape, np.nan)
    for joint in range(points.shape[1]):
        seen = is_seen[:, joint]
        if not seen.any():
            continue
        path = interpolate(frames, frames[seen], points[seen, joint])
        smooth[seen, joint] = _smooth_path(path, window)[seen]
    return smooth


def _root_before_camera(
    placement: Placement, towards_camera: Array, track: Track, is_known: Flags
) -> tuple[Array, Array]:
    """Return mid-hip (frame, 3) and direction to camera (frame, 3) by weak perspective; unknown frames interpolated.

    A person at `metres_per_pixel` s is s * focal away along the mid-hip's ray.
    """
    turn = swing_between(np.broadcast_to(np.array([0.0, 0.0, 1.0]), towards_camera.shape), towards_camera)
    scale = placement.metres_per_pixel
    place = np.nan_to_num(placement.mid_hip_px) * scale[:, None]
    depth = -scale * track.lens.focal_px
    root = rotate(turn, np.concatenate([place, depth[:, None]], axis=-1))
    frames = np.arange(len(root))
    is_placed = np.logical_and(is_known, np.isfinite(placement.mid_hip_px).all(axis=-1))
    if is_placed.any():
        root = interpolate(frames, frames[is_placed], root[is_placed])
    towards = -root / np.linalg.norm(root, axis=-1, keepdims=True)
    return root, towards
