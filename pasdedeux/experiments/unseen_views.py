"""A motion the database does not hold, seen from several directions and reconstructed by every method.

Yiannakides et al. (2019, section 6) compare a reconstruction with the held-out motion it was projected from, and two
reconstructions of one motion from views 75 and 135 degrees apart.  Two settings say two things: on the database's own
body by parallel rays (`parallel_views`), as it seems the paper did, search, choice over time and fit are measured by
themselves; by a pinhole on the person's own body (`pinhole_views`), with proportions, scale and lens unknown, it is
what users have.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import partial

import numpy as np
import numpy.typing as npt

from pasdedeux.cameras.virtual_video import PERSON_HEIGHT_M, PERSON_HEIGHT_PX, look_at_camera
from pasdedeux.errors import InputError
from pasdedeux.evaluation.reconstruction_metrics import (
    foot_slide_m,
    jitter_m,
    root_centred_error_m,
    root_removed_error_m,
    scale_free_error_m,
)
from pasdedeux.evaluation.scores import Score, scores_of
from pasdedeux.experiments.published_search import Codebook, search_published
from pasdedeux.fitting.observed_pose import ObservedFitSettings
from pasdedeux.kinematics.rotations import yaw_rotmat
from pasdedeux.projections.retarget import mid_hip, retarget_proportions
from pasdedeux.projections.search import recall
from pasdedeux.reconstruction.cleanup import clean_reconstructions
from pasdedeux.reconstruction.live.chain import LiveOptions, LivePerson
from pasdedeux.reconstruction.live.window_fit import WindowFitOptions
from pasdedeux.reconstruction.pitch import floor_offset, sized_by_height
from pasdedeux.reconstruction.proportions import retarget_image
from pasdedeux.reconstruction.reconstruct import (
    Matches,
    Method,
    Reconstruction,
    ReconstructionOptions,
    Searcher,
    match_track,
    reconstruct_track,
)
from pasdedeux.reconstruction.tracks import Lens, Track
from pasdedeux.skeletons import OP14

__all__ = [
    "AS_PUBLISHED",
    "BEST_MARK",
    "CLEAN",
    "CONDITIONS",
    "LIVE",
    "Condition",
    "Setting",
    "Tried",
    "UnseenMotion",
    "ViewedMotion",
    "best_candidates",
    "level_scores",
    "reconstruct_seen",
    "see",
    "unseen_view_scores",
]

Array = npt.NDArray[np.float64]
Stream = Callable[[int], np.random.Generator]

BEST_MARK = "best_of_50"
AS_PUBLISHED = "as_published"
LIVE = "live"
"""Frame by frame, each pose a few frames after its image."""
CLEAN = "_clean"
"""Appended to the name of a method whose motion was cleaned up."""
ALL_VIEWS = "mean of views"

_PIXELS_PER_METRE = 1000.0
_FAR_PX = 1e9
"""Focal length of a lens whose rays are parallel to one part in a million."""

_DISTANCE_M = 4.0
_IMAGE_PX = (1920, 1080)


class Setting(StrEnum):
    """How a motion is seen, named as the topic that scores it."""

    PARALLEL = "parallel_views"
    PINHOLE = "pinhole_views"


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

_KNOWN_PROPORTIONS = ReconstructionOptions(has_own_proportions=False, fit=ObservedFitSettings(min_noise_m=0.002))
"""The scale is not known."""


@dataclass(frozen=True)
class Condition:
    """What is done to the image.

    Args:
        name: For the tables.
        noise: Standard deviation of each coordinate's noise, as a part of the length of the torso.
        missing: Share of the joints hidden, each on its own.
        has_scale: Metres per pixel are known, of parallel rays; estimated from the track otherwise.
        has_height: The height of the pinhole over the floor is known, which gives the person's size.
    """

    name: str
    noise: float = 0.0
    missing: float = 0.0
    has_scale: bool = True
    has_height: bool = False


_COMMON = (
    Condition("clean"),
    Condition("noise 3 % of the torso", noise=0.03),
    Condition("30 % of the joints missing", missing=0.3),
)
CONDITIONS: Mapping[Setting, tuple[Condition, ...]] = {
    Setting.PARALLEL: (*_COMMON, Condition("clean, scale estimated", has_scale=False)),
    Setting.PINHOLE: (*_COMMON, Condition("clean, height of the camera known", has_height=True)),
}


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
class Tried:
    """What a motion is reconstructed by.

    Args:
        methods: Which methods.
        codebook: Clusters of the database: the published search and the window rule make `as_published` then.
        has_clean_up: Every method gives one more motion, cleaned up; the mark gives none.
        has_live: The live chain gives its motion too, unless the camera's height is known, which it has no use for.
    """

    methods: Sequence[Method] = tuple(Method)
    codebook: Codebook | None = None
    has_clean_up: bool = False
    has_live: bool = False


@dataclass(frozen=True)
class ViewedMotion:
    """A motion as a camera sees it.

    Args:
        track: The keypoints.
        truth_m: The motion (frame, 14, 3), camera axes, metres.
        options: How it is reconstructed.
        camera_height_m: Height of the camera over the floor where it is known.
    """

    track: Track
    truth_m: Array
    options: ReconstructionOptions
    camera_height_m: float | None = None


def see(
    motion: UnseenMotion, setting: Setting, condition: Condition, yaw_deg: float, rng: np.random.Generator
) -> ViewedMotion:
    """Return what a camera `yaw_deg` about +Y sees of a motion; the generator draws noise and hidden joints.

    By parallel rays the motion is put on the database's body first, its root path kept.  The pinhole stands level with
    the middle of the hips, 4 m from it; a lens of the same picture angle as most is assumed of it.
    """
    world_m = motion.world_m
    shape = world_m.shape[:2]
    height = None
    noise = rng.normal(0.0, 1.0, (*shape, 2)) * condition.noise
    hidden = rng.uniform(size=shape) < condition.missing
    body = retarget_proportions(world_m) if setting is Setting.PARALLEL else world_m
    middle = mid_hip(body).mean(axis=0)
    torso = float(np.median(np.linalg.norm(body[:, OP14.root] - mid_hip(body), axis=-1)))
    if setting is Setting.PARALLEL:
        truth = np.asarray((body - middle) @ yaw_rotmat(np.deg2rad(yaw_deg)).T)
        clear = truth[..., :2] * np.array([_PIXELS_PER_METRE, -_PIXELS_PER_METRE])
        noise_px, lens = noise * torso * _PIXELS_PER_METRE, Lens(_FAR_PX, (0.0, 0.0))
        options = _KNOWN_BODY if condition.has_scale else _KNOWN_PROPORTIONS
    else:
        focal = PERSON_HEIGHT_PX * _DISTANCE_M / PERSON_HEIGHT_M
        camera = look_at_camera(
            middle,
            distance_m=_DISTANCE_M,
            # A camera that goes round to the right sees what a body that turns to the left shows.
            yaw_rad=-np.deg2rad(yaw_deg),
            pitch_rad=0.0,
            focal_px=focal,
            image_size_px=_IMAGE_PX,
        )
        truth = (body - camera.position_m) @ camera.camera_from_world_rotmat.T
        clear = camera.project(body).px
        noise_px, lens = noise * torso * focal / _DISTANCE_M, Lens.assumed(*_IMAGE_PX, clear)
        options = ReconstructionOptions()
        height = float(camera.position_m[1]) if condition.has_height else None
    px = np.where(hidden[..., None], np.nan, clear + noise_px)
    return ViewedMotion(Track(px, np.where(hidden, 0.0, 1.0), motion.rate_hz, lens), truth, options, height)


def best_candidates(searcher: Searcher, found: Matches, truth_m: Array) -> Array:
    """Return for each frame the candidate (frame, 14, 3) nearest to the truth (frame, 14, 3): a mark, not a method.

    Candidates are on the reference body.  Frames without candidates have NaN.
    """
    neighbours = found.neighbours
    poses = searcher.database.turned(np.maximum(neighbours.row, 0), found.yaws)
    poses = np.einsum("ij,...nj->...ni", searcher.database.camera.camera_from_upright_rotmat, poses)
    centred = truth_m - mid_hip(truth_m)[:, None]
    error = np.linalg.norm(poses - centred[:, None], axis=-1).mean(axis=-1)
    error[neighbours.projection < 0] = np.inf
    best = np.take_along_axis(poses, np.argmin(error, axis=1)[:, None, None, None], axis=1)[:, 0]
    best[~np.isfinite(error).any(axis=1)] = np.nan
    return np.asarray(best)


def reconstruct_seen(searcher: Searcher, seen: ViewedMotion, tried: Tried) -> tuple[dict[str, Array], dict[str, float]]:
    """Return a motion (frame, 14, 3) in camera axes by method, and the recall of the published search where it is made.

    The database of the searcher has not seen the motion.
    """
    camera = searcher.database.camera
    track, options = seen.track, seen.options
    found = match_track(searcher, track, options)
    made: dict[str, Reconstruction] = {
        method.value: reconstruct_track(searcher, track, method, options, matches=found) for method in tried.methods
    }
    recalls: dict[str, float] = {}
    if tried.codebook is not None:
        published = search_published(searcher.database, tried.codebook, found.query_m, found.weights)
        made[AS_PUBLISHED] = reconstruct_track(
            searcher, track, Method.WINDOW, options, matches=replace(found, neighbours=published, yaw_steps=None)
        )
        exact = searcher.index.search(
            retarget_image(found.query_m, found.proportions), found.weights, num_neighbours=options.num_candidates
        )
        recalls = {f"recall_at_{n}": recall(published, exact, num_best=n) for n in (1, 50)}
    if seen.camera_height_m is not None:
        made = {name: sized_by_height(one, camera, seen.camera_height_m) for name, one in made.items()}
    motions = {BEST_MARK: best_candidates(searcher, found, seen.truth_m)}
    for name, one in made.items():
        motions[name] = one.positions_m
        if tried.has_clean_up:
            (cleaned,) = clean_reconstructions([(0, one)], floor_offset([one], camera), camera, rate_hz=track.rate_hz)
            motions[name + CLEAN] = cleaned.positions_m
    if tried.has_live and seen.camera_height_m is None:
        motions[LIVE] = _live_motion(searcher, seen, has_clean_up=False)
        if tried.has_clean_up:
            motions[LIVE + CLEAN] = _live_motion(searcher, seen, has_clean_up=True)
    return motions, recalls


def _live_motion(searcher: Searcher, seen: ViewedMotion, *, has_clean_up: bool) -> Array:
    """Return a motion (frame, 14, 3) in camera axes as it leaves the live chain; NaN in frames without a pose."""
    options = seen.options
    fit = WindowFitOptions()
    if options.metres_per_pixel is not None:
        fit = fit.model_copy(update={"min_noise_m": options.fit.min_noise_m})
    live = LiveOptions(
        min_joints=options.min_joints,
        metres_per_pixel=options.metres_per_pixel,
        has_own_proportions=options.has_own_proportions,
        has_clean_up=has_clean_up,
        fit=fit,
    )
    track = seen.track
    person = LivePerson(0, searcher, rate_hz=track.rate_hz, lens=track.lens, options=live)
    poses = []
    for frame, (points, confidence) in enumerate(zip(track.keypoints_px, track.confidence, strict=True)):
        poses += person.push(frame, points, confidence)
    motion = np.full((*track.confidence.shape, 3), np.nan)
    for pose in [*poses, *person.finish()]:
        motion[pose.frame] = pose.positions_m
    return motion


def unseen_view_scores(
    searcher: Searcher, motion: UnseenMotion, setting: Setting, condition: Condition, tried: Tried, stream: Stream
) -> list[Score]:
    """Score every method on a motion seen from several directions, and how far its reconstructions differ.

    The database has not seen the motion and is of a level camera; `stream` gives the random stream of a view.
    """
    figures, motions = _measure(searcher, motion, setting, condition, tried, stream)
    item, count = motion.item, len(motion.world_m)
    scores = []
    for (metric, method), values in figures.items():
        unit = "" if metric.startswith("recall") else "m"
        named = [(f"{item} at {yaw:g} degrees", value) for yaw, value in zip(motion.yaws_deg, values, strict=True)]
        named += [(f"{item}, {ALL_VIEWS}", float(np.mean(values)))] if len(values) > 1 else []
        scores += [
            Score(metric, method, value, unit, _is_baseline(method), condition.name, label, count=count)
            for label, value in named
        ]
    for method, found in motions.items():
        for yaw, other in zip(motion.yaws_deg[1:], found[1:], strict=True):
            differs = {"two_views_differ": _mean(root_removed_error_m(found[0], other))}
            label = f"{item}, views {abs(yaw - motion.yaws_deg[0]):g} degrees apart"
            more = {"is_baseline": _is_baseline(method), "split": condition.name, "item": label, "count": count}
            scores += scores_of(differs, method, "m", **more)
    return scores


def level_scores(
    searcher: Searcher,
    motion: UnseenMotion,
    setting: Setting,
    *,
    kind: str,
    levels: Sequence[float],
    methods: Sequence[Method],
    stream: Callable[[int, int], np.random.Generator],
) -> list[Score]:
    """Score methods at growing levels of `noise` or `missing` joints, means over the views: points of curves.

    The metric is `error_root_kept_by_<kind>`; its level stands in `at`, a part of the torso or of the joints.

    Raises:
        InputError: Another kind.
    """
    if kind not in ("noise", "missing"):
        raise InputError(f"sweep over '{kind}' is not known; known: noise, missing")
    scores = []
    for number, level in enumerate(levels):
        name = f"{kind} {level:g}"
        condition = Condition(name, noise=level) if kind == "noise" else Condition(name, missing=level)
        figures, _ = _measure(searcher, motion, setting, condition, Tried(methods), partial(stream, number))
        for (metric, method), values in figures.items():
            if metric == "error_root_kept":
                mean = {f"{metric}_by_{kind}": float(np.mean(values))}
                more = {"split": "sweep", "item": motion.item, "at": level, "count": len(motion.world_m) * len(values)}
                scores += scores_of(mean, method, "m", is_baseline=_is_baseline(method), **more)
    return scores


def _measure(
    searcher: Searcher, motion: UnseenMotion, setting: Setting, condition: Condition, tried: Tried, stream: Stream
) -> tuple[dict[tuple[str, str], list[float]], dict[str, list[Array]]]:
    """Return the figures of each view by metric and method, and the motions of each view by method."""
    # Parallel rays of unknown scale leave the depth of the trajectory open: a thousandth of scale is a thousandth of
    # infinity.
    has_trajectory = setting is Setting.PINHOLE or condition.has_scale
    rate_hz = motion.rate_hz
    figures: dict[tuple[str, str], list[float]] = {}
    motions: dict[str, list[Array]] = {}
    for view, yaw in enumerate(motion.yaws_deg):
        seen = see(motion, setting, condition, yaw, stream(view))
        made, recalls = reconstruct_seen(searcher, seen, tried)
        for method, positions in made.items():
            motions.setdefault(method, []).append(positions)
            slide_hz = rate_hz if has_trajectory and method != BEST_MARK else None
            for metric, value in _figures(positions, seen.truth_m, rate_hz=slide_hz).items():
                figures.setdefault((metric, method), []).append(value)
        for metric in ("jitter", "foot_slide"):
            value = _figures(seen.truth_m, seen.truth_m, rate_hz=rate_hz)[metric]
            figures.setdefault((metric, "truth"), []).append(value)
        for metric, value in recalls.items():
            figures.setdefault((metric, AS_PUBLISHED), []).append(value)
    return figures, motions


def _figures(found: Array, truth: Array, *, rate_hz: float | None) -> dict[str, float]:
    """Return errors of a motion, and how far its feet slide where a rate is given (its trajectory must be known)."""
    is_known = np.isfinite(found).all(axis=(1, 2))
    known = found[is_known]
    centred = known - mid_hip(known)[:, None]
    figures = {
        "error_root_kept": _mean(root_centred_error_m(found, truth)),
        "error_root_removed": _mean(root_removed_error_m(found, truth)),
        "error_scale_free": _mean(scale_free_error_m(known, truth[is_known])),
        "jitter": jitter_m(centred),
    }
    return figures if rate_hz is None else {**figures, "foot_slide": foot_slide_m(found, truth, rate_hz=rate_hz)}


def _mean(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else float("nan")


def _is_baseline(method: str) -> bool:
    return method.removesuffix(CLEAN) in (Method.NEAREST.value, BEST_MARK, AS_PUBLISHED, "truth")
