"""The views of annotated pairs: weighted hypotheses of where the camera stood (Yin et al. 2018, section 4.2).

Lifted torsos give two backbones, each with a twin mirrored in depth, and the scale of each person.  A weak-perspective
image does not show which root is nearer, so several rules give their relative depth:

- `zero`: both at the same depth;
- `contact_near`, `contact_far`: roots at the distance of bodies in contact, person B nearer or further; no such
  hypothesis if the roots are further apart in the image;
- `size`: by the apparent sizes, given a known or assumed distance of the camera;
- `near`, `far`: person B nearer or further than that (than `zero` when the distance is unknown) by sqrt(3) standard
  deviations, so that the three together have the mean and variance of the relative depth.

The weight of a hypothesis depends on the lean of the backbones (people stand nearly upright, and cameras are held
nearly level), on how well its depth agrees with the apparent sizes, and on whether the bodies would overlap.  The fit
of the torso does not show which twin is true (for captured dancers, the better fit was right in 36-49 % of the cases),
so it does not count.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from pydantic import Field

from pasdedeux.arrays import Array, Flags, Integers
from pasdedeux.cameras.frames import angles_of_direction, local_frame
from pasdedeux.cameras.orthographic import metres_from_pixels
from pasdedeux.cameras.torso import TORSO_INDICES, TorsoBasis, lift_torsos
from pasdedeux.settings import Settings

DEPTH_RULES = ("zero", "contact_near", "contact_far", "size", "near", "far")
_ZERO, _CONTACT_NEAR, _CONTACT_FAR, _SIZE, _NEAR, _FAR = range(6)
_FLIPS = np.array([(0, 0), (1, 0), (0, 1), (1, 1)])
"""Twins of person A and B under each choice, (flip, person)."""
_SAME_TWIN = [0, 3]

BODY_DEVIATION = 0.06
"""Prior standard deviation of the logarithm of the ratio of two adults' statures."""

MIN_CALIBRATION_DEVIATION = 0.02
"""Error of a size ratio that remains however often two people pass around each other."""
_SIZE_DEVIATION = 0.035
"""Relative error of the ratio of apparent sizes, in addition to those of fit and bodies."""
_CONTACT_DISTANCE_M = 0.35
"""Distance of the roots of two people in close contact."""
_MIN_ROOT_DISTANCE_M = 0.2
"""Smallest plausible distance of two roots."""
_MIN_WEIGHT = 1e-3
"""Hypotheses of less weight are dropped."""
_DEPTH_DEVIATION_M = 0.6
"""Standard deviation of the relative depth of two roots."""
USUAL_DISTANCE_M = 4.0
"""Distance assumed of an unknown camera, metres."""


class ViewOptions(Settings):
    """Assumptions about cameras and people for the estimation of views.

    The ratio of the two bodies' sizes is estimated from that of their apparent sizes over all annotations.  Many
    cameras determine it well; one camera does so only if the two people pass around each other in front of it.
    """

    distance_m: float | None = Field(
        USUAL_DISTANCE_M,
        gt=0,
        description="Distance of the cameras, known or assumed; none: apparent size says nothing of depth",
    )
    camera_pitch_deg: float = Field(10.0, ge=-89, le=89, description="Mean elevation of the cameras")
    camera_pitch_deviation_deg: float = Field(12.0, gt=0, description="Standard deviation of the elevation")
    lean_deviation_deg: float = Field(20.0, gt=0, description="Standard deviation of a backbone from the vertical")


@dataclass(frozen=True)
class ViewEstimates:
    """Hypotheses of n annotations, flat: sorted by annotation, within one by falling weight.

    Args:
        annotation: Index of the annotation, (h,).
        hypothesis: Index within the annotation, (h,); 0 is the likeliest.
        depth_rule: Index into `DEPTH_RULES`, (h,).
        flip: Torso twins, (h,): bit 0 for person A, bit 1 for person B; set where the neck is the further one.
        root_depth_m: Depth of root B against root A, towards the camera positive, (h,), metres.
        direction: View in the local frame of the hypothesis, (h, 3), unit.
        weight: (h,); those of one annotation sum to 1.
        metres_per_pixel: Scale of each person, (h, person=2).
        trust: Trust in each annotation's view, (n,): length of the weighted mean direction, 1 when all hypotheses
            agree; 0 where there is none.
        is_lifted: Which annotations have hypotheses, (n,): enough torso joints of both people were seen.
        size_ratio: Estimated size of person A over person B.
    """

    annotation: Integers
    hypothesis: Integers
    depth_rule: Integers
    flip: Integers
    root_depth_m: Array
    direction: Array
    weight: Array
    metres_per_pixel: Array
    trust: Array
    is_lifted: Flags
    size_ratio: float

    def angles(self) -> tuple[Array, Array]:
        """Return (psi, phi) of every hypothesis, lift eq. 4, radians."""
        return angles_of_direction(self.direction)


def estimate_views(
    pair17_px: Array,
    basis: TorsoBasis,
    *,
    confidence: Array | None = None,
    camera_index: Integers | None = None,
    options: ViewOptions | None = None,
) -> ViewEstimates:
    """Estimate the views of annotated pairs.

    Args:
        pair17_px: Pairs (n, person=2, joint=17, 2), pixels, x right, y down; NaN where a joint is missing.
        basis: Torso basis learned from other takes.
        confidence: Weights of the joints, (n, person=2, joint=17); all 1 when not given.
        camera_index: Number of the camera of each annotation, (n,); a different one for each by default.
        options: Assumptions.

    Person A must be the same person in all annotations.  An annotation in which either torso has too few joints gets no
    hypothesis and trust 0.
    """
    options = options or ViewOptions()
    px = np.asarray(pair17_px, dtype=np.float64)
    count = len(px)
    torso_px = px[:, :, TORSO_INDICES].reshape(-1, len(TORSO_INDICES), 2)
    weights = None
    if confidence is not None:
        weights = np.asarray(confidence, dtype=np.float64)[:, :, TORSO_INDICES].reshape(-1, len(TORSO_INDICES))
    lifted = lift_torsos(torso_px, basis, weights=weights)
    is_lifted = np.asarray(lifted.is_lifted.reshape(count, 2).all(axis=1))
    rows = np.flatnonzero(is_lifted)
    twins = _Twins(
        *(
            values.reshape(count, 2, *values.shape[1:])[rows][:, np.arange(2), _FLIPS]
            for values in (lifted.backbones, lifted.metres_per_pixel, lifted.root_px, lifted.log_scale_deviation)
        )
    )
    cameras = np.arange(count) if camera_index is None else np.asarray(camera_index)
    log_ratio, size_variance = _size_ratio(twins, cameras[rows], options)
    # Correct each size by half of the ratio, so that the mean size stays that of the basis.
    twins = replace(twins, metres_per_pixel=twins.metres_per_pixel * np.exp(np.array([0.5, -0.5]) * log_ratio))
    hypotheses = _hypotheses(twins, size_variance, options)
    each_rule = (len(rows), len(_FLIPS) * len(DEPTH_RULES))
    log_weight, direction = hypotheses.log_weight.reshape(each_rule), hypotheses.direction.reshape(*each_rule, 3)
    weight = np.exp(log_weight - log_weight.max(axis=1, keepdims=True))
    weight /= weight.sum(axis=1, keepdims=True)
    weight = np.where(weight < _MIN_WEIGHT, 0.0, weight)
    weight /= weight.sum(axis=1, keepdims=True)
    trust = np.zeros(count)
    trust[rows] = np.linalg.norm((weight[..., None] * direction).sum(axis=1), axis=-1)

    order = np.argsort(-weight, axis=1, kind="stable")
    each, place = np.nonzero(np.take_along_axis(weight, order, axis=1) > 0)
    column = order[each, place]
    return ViewEstimates(
        annotation=rows[each],
        hypothesis=place,
        depth_rule=column % len(DEPTH_RULES),
        flip=column // len(DEPTH_RULES),
        root_depth_m=hypotheses.depth_m.reshape(each_rule)[each, column],
        direction=direction[each, column],
        weight=weight[each, column],
        metres_per_pixel=twins.metres_per_pixel[each, column // len(DEPTH_RULES)],
        trust=np.minimum(trust, 1.0),
        is_lifted=is_lifted,
        size_ratio=float(np.exp(log_ratio)),
    )


def pair_in_metres(pair17_px: Array, metres_per_pixel: Array) -> Array:
    """Return annotated pairs (*batch, person=2, joint, 2) in metres, x right, y up, the middle of the roots at (0, 0).

    Each person is scaled about their pelvis by their own scale (*batch, person=2); the distance between the pelvises is
    scaled by the mean of the two, as for a pinhole and people at two depths.  If a pelvis is missing, both people are
    placed by the mean of the joints seen in both.
    """
    px = np.asarray(pair17_px, dtype=np.float64)
    scale = np.asarray(metres_per_pixel, dtype=np.float64)
    anchor = px[..., 0, :]
    is_missing = ~np.asarray(np.isfinite(anchor).all(axis=(-1, -2)))
    if is_missing.any():
        shared = np.asarray(np.isfinite(px).all(axis=(-1, -3)))[..., None, :, None]
        total = np.where(shared, px, 0.0).sum(axis=-2) / np.maximum(shared.sum(axis=-2), 1)
        anchor = np.where(is_missing[..., None, None], total, anchor)
    people_m = metres_from_pixels(px, scale, anchor)
    between = (anchor[..., 1, :] - anchor[..., 0, :]) * np.array([1.0, -1.0]) * scale.mean(axis=-1)[..., None]
    place = between[..., None, :] * np.array([[-0.5], [0.5]])
    return np.asarray(people_m + place[..., None, :])


@dataclass(frozen=True)
class _Twins:
    """The lifted torsos of pairs under each choice of twins: arrays (pair, flip, person, ...)."""

    backbones: Array
    metres_per_pixel: Array
    root_px: Array
    log_scale_deviation: Array


@dataclass(frozen=True)
class _Hypotheses:
    """All depth rules under each choice of twins: arrays (pair, flip, rule, ...)."""

    depth_m: Array
    direction: Array
    log_weight: Array


def _size_ratio(twins: _Twins, cameras: Integers, options: ViewOptions) -> tuple[float, float]:
    """Return the logarithm of the size of person A over person B, and its variance.

    It is the weighted median of the apparent ratio over cameras, drawn to 0 by the prior.  If person B stays on one
    side of A, B may always be nearer, so the camera has the weight of a single frame; the more evenly the two change
    sides, the more their depths balance.
    """
    if not len(cameras):
        return 0.0, BODY_DEVIATION**2
    scale, x = twins.metres_per_pixel[:, _SAME_TWIN], twins.root_px[..., 0][:, _SAME_TWIN]
    # A smaller body, fitted with the same mean torso, gets too many metres per pixel.
    apparent = np.log(scale[..., 1] / scale[..., 0]).mean(axis=-1)
    across = (x[..., 1] - x[..., 0]).mean(axis=-1)
    one_frame = _DEPTH_DEVIATION_M / (options.distance_m or USUAL_DISTANCE_M)
    ratio, precision = [], []
    for camera in np.unique(cameras):
        is_camera = cameras == camera
        one_sided = abs(across[is_camera].sum()) / max(float(np.abs(across[is_camera]).sum()), 1e-12)
        ratio.append(float(np.median(apparent[is_camera])))
        precision.append(1.0 / ((one_frame * one_sided) ** 2 + MIN_CALIBRATION_DEVIATION**2))
    order = np.argsort(ratio)
    cumulative = np.cumsum(np.array(precision)[order])
    # The mean of the lower and the upper weighted median, so that swapping the people inverts the ratio exactly.
    lower = np.searchsorted(cumulative, 0.5 * cumulative[-1] * (1.0 - 1e-9))
    upper = np.searchsorted(cumulative, 0.5 * cumulative[-1] * (1.0 + 1e-9))
    median = 0.5 * (ratio[order[lower]] + ratio[order[upper]])
    # The smallest error remains, whatever the number of cameras.
    total = min(float(cumulative[-1]), 1.0 / MIN_CALIBRATION_DEVIATION**2) + 1.0 / BODY_DEVIATION**2
    return median * (1.0 - 1.0 / (total * BODY_DEVIATION**2)), 1.0 / total


def _hypotheses(twins: _Twins, size_variance: float, options: ViewOptions) -> _Hypotheses:
    scale, root_px = twins.metres_per_pixel, twins.root_px
    across = (root_px[..., 1, :] - root_px[..., 0, :]) * np.array([1.0, -1.0]) * scale.mean(axis=-1)[..., None]
    gap = np.linalg.norm(across, axis=-1)

    depth = np.zeros((*gap.shape, len(DEPTH_RULES)))
    log_weight = np.zeros_like(depth)
    reach = np.sqrt(np.maximum(_CONTACT_DISTANCE_M**2 - gap**2, 0.0))
    depth[..., _CONTACT_NEAR], depth[..., _CONTACT_FAR] = reach, -reach
    # The relative depth is normal with this mean and variance.
    mean, variance = np.zeros(gap.shape), np.full(gap.shape, _DEPTH_DEVIATION_M**2)
    if options.distance_m is not None:
        # Depth is proportional to metres per pixel; the two depths have the camera's distance as their mean.
        apparent = 2.0 * options.distance_m * (scale[..., 0] - scale[..., 1]) / scale.sum(axis=-1)
        fit_variance = (twins.log_scale_deviation**2).sum(axis=-1)
        noise = options.distance_m**2 * (_SIZE_DEVIATION**2 + size_variance + fit_variance)
        # The mean stays the apparent depth: a normal prior would draw it towards 0 and turn every view the same way,
        # which cost 3 degrees in the median on captured dancers.
        mean, variance = apparent, variance * noise / (variance + noise)
    step = np.sqrt(3.0 * variance)
    depth[..., _SIZE], depth[..., _NEAR], depth[..., _FAR] = mean, mean + step, mean - step
    centre = _ZERO if options.distance_m is None else _SIZE
    for rule in range(len(DEPTH_RULES)):
        agreement = -0.5 * (depth[..., rule] - mean) ** 2 / variance
        log_weight[..., rule] = 0.0 if rule in (_NEAR, _FAR) else agreement
        log_weight[..., rule] += np.log(2 / 3) if rule == centre else np.log(1 / 6)
    log_weight[..., [_CONTACT_NEAR, _CONTACT_FAR]] += np.where(reach > 0, 0.0, -np.inf)[..., None]
    if options.distance_m is None:
        log_weight[..., _SIZE] = -np.inf
    distance = np.sqrt(gap[..., None] ** 2 + depth**2)
    shortfall = np.maximum(_MIN_ROOT_DISTANCE_M - distance, 0.0) / (0.5 * _MIN_ROOT_DISTANCE_M)
    log_weight -= 0.5 * shortfall**2
    log_weight += _log_lean(twins.backbones, options)[..., None]

    roots = np.zeros((*depth.shape, 2, 3))
    roots[..., 1, :2] = across[..., None, :]
    roots[..., 1, 2] = depth
    frame = local_frame(roots, np.broadcast_to(twins.backbones[..., None, :, :], roots.shape))
    direction = frame.coordinates(np.broadcast_to(np.array([0.0, 0.0, 1.0]), (*depth.shape, 3)))
    return _Hypotheses(depth_m=depth, direction=direction, log_weight=log_weight)


def _log_lean(backbones: Array, options: ViewOptions) -> Array:
    """Log weight of the backbones' leans towards the camera: an upright person leans by the camera's elevation."""
    lean = np.arctan2(backbones[..., 2], np.linalg.norm(backbones[..., :2], axis=-1))
    lean = lean - np.deg2rad(options.camera_pitch_deg)
    single, shared = (
        float(np.deg2rad(d)) ** 2 for d in (options.lean_deviation_deg, options.camera_pitch_deviation_deg)
    )
    # Inverse of own x identity + shared x ones for two people.
    total = lean.sum(axis=-1)
    return np.asarray(-0.5 * ((lean**2).sum(axis=-1) - shared * total**2 / (single + 2.0 * shared)) / single)
