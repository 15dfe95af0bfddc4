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
from pasdedeux.evaluation.scores import Score
from pasdedeux.experiments.published_search import Codebook, search_published
from pasdedeux.fitting.observed_pose import ObservedFitSettings
from pasdedeux.kinematics.rotations import yaw_rotmat
from pasdedeux.projections.retarget import mid_hip, retarget_proportions
from pasdedeux.projections.search import recall
from pasdedeux.reconstruction.cleanup import clean_reconstruction
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


CONDITIONS: Mapping[Setting, tuple[Condition, ...]] = {
    Setting.PARALLEL: (
        Condition("clean"),
        Condition("noise 3 % of the torso", noise=0.03),
        Condition("30 % of the joints missing", missing=0.3),
        Condition("clean, scale estimated", has_scale=False),
    ),
    Setting.PINHOLE: (
        Condition("clean"),
        Condition("noise 3 % of the torso", noise=0.03),
        Condition("30 % of the joints missing", missing=0.3),
        Condition("clean, height of the camera known", has_height=True),
    ),
}


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
    world_m: Array, setting: Setting, condition: Condition, *, yaw_deg: float, rate_hz: float, rng: np.random.Generator
) -> ViewedMotion:
    """Return what a camera `yaw_deg` about +Y sees of a motion.

    Args:
        world_m: The motion (frame, 14, 3), upright axes, floor at 0, its own proportions and way, metres.
        setting: By parallel rays the motion is put on the database's body first, its way kept.  The pinhole stands
            level with the middle of the hips, 4 m from it; a lens of the same picture angle as most is assumed of it.
        condition: What is done to the image.
        yaw_deg: Direction.
        rate_hz: Rate of the motion.
        rng: Draws noise and hidden joints.
    """
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
    return ViewedMotion(Track(px, np.where(hidden, 0.0, 1.0), rate_hz, lens), truth, options, height)


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


def reconstruct_seen(
    searcher: Searcher,
    seen: ViewedMotion,
    *,
    methods: Sequence[Method] = tuple(Method),
    codebook: Codebook | None = None,
    has_clean_up: bool = True,
    has_live: bool = False,
) -> tuple[dict[str, Array], dict[str, float]]:
    """Return a motion (frame, 14, 3) in camera axes by method, and the recall of the published search where it is made.

    Args:
        searcher: Database that has not seen the motion.
        seen: What is reconstructed.
        methods: Which methods.
        codebook: Clusters of the database: the published search and the window rule make `as_published` then.
        has_clean_up: Every method gives one more motion, cleaned up; the mark gives none.
        has_live: The live chain gives its motion too, unless the camera's height is known, which it has no use for.
    """
    camera = searcher.database.camera
    track, options = seen.track, seen.options
    found = match_track(searcher, track, options)
    made: dict[str, Reconstruction] = {
        method.value: reconstruct_track(searcher, track, method, options, matches=found) for method in methods
    }
    recalls: dict[str, float] = {}
    if codebook is not None:
        published = search_published(searcher.database, codebook, found.query_m, found.weights)
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
        if has_clean_up:
            cleaned = clean_reconstruction(one, floor_offset([one], camera), camera, rate_hz=track.rate_hz)
            motions[name + CLEAN] = cleaned.positions_m
    if has_live and seen.camera_height_m is None:
        motions[LIVE] = live_motion(searcher, seen, has_clean_up=False)
        if has_clean_up:
            motions[LIVE + CLEAN] = live_motion(searcher, seen, has_clean_up=True)
    return motions, recalls


def live_motion(searcher: Searcher, seen: ViewedMotion, *, has_clean_up: bool) -> Array:
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
    searcher: Searcher,
    world_m: Array,
    setting: Setting,
    condition: Condition,
    *,
    rate_hz: float,
    item: str,
    yaws_deg: Sequence[float],
    stream: Stream,
    codebook: Codebook | None = None,
    methods: Sequence[Method] = tuple(Method),
    has_clean_up: bool = True,
    has_live: bool = False,
) -> list[Score]:
    """Score every method on a motion seen from several directions, and how far its reconstructions differ.

    Args:
        searcher: Database that has not seen the motion, of a level camera.
        world_m: The motion (frame, 14, 3), upright axes.
        setting: How it is seen.
        condition: What is done to the images.
        rate_hz: Its rate.
        item: Name of the motion, for the table.
        yaws_deg: Directions it is seen from; each later one is also compared with the first.
        stream: Gives the random stream of a view.
        codebook: Clusters of the database: the published search and the window rule are then scored too.
        methods: Which methods.
        has_clean_up: Also with the clean-up.
        has_live: Also as it leaves the live chain.
    """
    # Parallel rays of unknown scale leave the depth of the trajectory open: a thousandth of scale is a thousandth of
    # infinity.
    has_trajectory = setting is Setting.PINHOLE or condition.has_scale
    figures: dict[tuple[str, str], list[float]] = {}
    motions: dict[str, list[Array]] = {}
    for view, yaw in enumerate(yaws_deg):
        seen = see(world_m, setting, condition, yaw_deg=yaw, rate_hz=rate_hz, rng=stream(view))
        made, recalls = reconstruct_seen(
            searcher, seen, methods=methods, codebook=codebook, has_clean_up=has_clean_up, has_live=has_live
        )
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
    count = len(world_m)
    scores = []
    for (metric, method), values in figures.items():
        unit = "" if metric.startswith("recall") else "m"
        named = [(f"{item} at {yaw:g} degrees", value) for yaw, value in zip(yaws_deg, values, strict=True)]
        named += [(f"{item}, {ALL_VIEWS}", float(np.mean(values)))] if len(values) > 1 else []
        scores += [
            Score(metric, method, value, unit, _is_baseline(method), condition.name, label, count=count)
            for label, value in named
        ]
    for method, found in motions.items():
        for yaw, other in zip(yaws_deg[1:], found[1:], strict=True):
            differs = _mean(root_removed_error_m(found[0], other))
            label = f"{item}, views {abs(yaw - yaws_deg[0]):g} degrees apart"
            scores.append(
                Score("two_views_differ", method, differs, "m", _is_baseline(method), condition.name, label,
                    count=count,
                )
            )  # fmt: skip
    return scores


def level_scores(
    searcher: Searcher,
    world_m: Array,
    setting: Setting,
    *,
    kind: str,
    levels: Sequence[float],
    rate_hz: float,
    item: str,
    yaws_deg: Sequence[float],
    stream: Callable[[int, int], np.random.Generator],
    methods: Sequence[Method],
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
        errors: dict[str, list[float]] = {}
        for view, yaw in enumerate(yaws_deg):
            seen = see(world_m, setting, condition, yaw_deg=yaw, rate_hz=rate_hz, rng=stream(number, view))
            made, _ = reconstruct_seen(searcher, seen, methods=methods, has_clean_up=False)
            for method, positions in made.items():
                errors.setdefault(method, []).append(_mean(root_centred_error_m(positions, seen.truth_m)))
        scores += [
            Score(
                f"error_root_kept_by_{kind}",
                method,
                float(np.mean(values)),
                "m",
                _is_baseline(method),
                "sweep",
                item,
                at=level,
                count=len(world_m) * len(values),
            )
            for method, values in errors.items()
        ]
    return scores


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
