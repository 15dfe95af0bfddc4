"""Baselines of lifting by sampling: lifting + IK, and naive sampling around it (Yin et al. 2018, Fig. 10).

Both use one image, joint limits and the rule that bodies do not overlap; neither knows how people interact.
"""

from __future__ import annotations

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.completion.fit import fit_people
from pasdedeux.plausibility.capsules import capsule_model
from pasdedeux.plausibility.joint_limits import JointLimits
from pasdedeux.sampling.parameters import LENGTH_INDICES, POSITION_INDICES, ROTATION_INDICES, PairChart
from pasdedeux.sampling.seeds import seed_quality
from pasdedeux.skeletons import PAIR17

_NUM_ROUNDS = 5
_IMAGE_DEVIATION_M, _VALID_DEVIATION_M, _DEPTH_DEVIATION_M = 0.01, 0.02, 0.3
_SLIDES_M = np.linspace(-0.6, 0.6, 61)
_TOUCHING_M = 0.01
"""Largest summed penetration that counts as none, metres, because captured bodies touch."""
_ROTATION_RAD, _POSITION_M = 0.15, 0.03
"""Standard deviations of naive samples: of a bone's turn, and of a root."""


def lift_by_ik(image_m: Array, pair_m: Array, lengths_m: Array, limits: JointLimits) -> Array:
    """Return the pair (person=2, joint=17, 3), metres, that minimises E_2D + E_isvalid from a lifted one.

    Args:
        image_m: Image points (2, 17, 2), metres; NaN where not seen.
        pair_m: Lifted pair (2, 17, 3), metres, camera axes.
        lengths_m: Bone lengths (2, 17), metres, kept exactly.
        limits: Joint limits.

    E_2D is the squared distance of the seen joints from the image, E_isvalid that of all joints from the closest valid
    pose, which is updated between fits.  Then one person slides along the line of sight, as little as possible, until
    the two do not overlap.
    """
    pair = np.asarray(pair_m, dtype=np.float64)
    image_weight, valid_weight = _IMAGE_DEVIATION_M**-2, _VALID_DEVIATION_M**-2
    is_seen = np.isfinite(image_m).all(axis=-1, keepdims=True)
    for _ in range(_NUM_ROUNDS):
        targets = limits.nearest_valid(pair).positions
        blended = (image_weight * np.where(is_seen, image_m, 0.0) + valid_weight * targets[..., :2]) / (
            image_weight + valid_weight
        )
        width = np.full(targets.shape, _VALID_DEVIATION_M)
        width[..., :2] = np.where(is_seen, (image_weight + valid_weight) ** -0.5, _VALID_DEVIATION_M)
        targets[..., :2] = np.where(is_seen, blended, targets[..., :2])
        pair = fit_people(targets, width, pair, lengths_m, bone_deviation_m=_DEPTH_DEVIATION_M)
    return resolve_penetration(pair)


def resolve_penetration(pair_m: Array) -> Array:
    """Slide person B along z, as little as possible, until the people of a pair (2, 17, 3), metres, do not overlap.

    If no slide up to 0.6 m is enough, take the slide with the least penetration.
    """
    model = capsule_model(PAIR17)
    slid = np.repeat(pair_m[None], len(_SLIDES_M), axis=0)
    slid[:, 1, :, 2] += _SLIDES_M[:, None]
    between = model.penetration(slid, model.radii_of(pair_m[None]))[:, 2]
    excess = np.maximum(between - between.min(), 0.0)
    order = np.lexsort((np.abs(_SLIDES_M), excess > _TOUCHING_M))
    return np.asarray(slid[order[0]])


def sample_naively(
    rng: np.random.Generator, image_m: Array, pair_m: Array, limits: JointLimits, *, num_samples: int
) -> Array:
    """Sample pairs around a pair; return the nearest to the image (person=2, joint=17, 3), metres, camera axes.

    Bone lengths are kept exactly.  Samples are drawn from twice as many normal perturbations, with probability in
    proportion to exp(-v / (2 sigma_p^2)), v the violation of eq. 2 (distance to valid poses and penetration).

    Args:
        rng: Random generator.
        image_m: Image points (2, 17, 2), metres; NaN where not seen.
        pair_m: Pair in camera axes, over the image.
        limits: Joint limits.
        num_samples: Number of samples (Yin et al. 2018: 1,000).
    """
    chart = PairChart(pair_m)
    start = chart.seed_parameters()
    step = np.full(len(start), _ROTATION_RAD)
    step[POSITION_INDICES.ravel()] = _POSITION_M
    step[ROTATION_INDICES.ravel()] = 0.5 * _ROTATION_RAD
    step[LENGTH_INDICES.ravel()] = 0.0
    tried = start + step * rng.normal(size=(2 * num_samples, len(start)))
    pairs = chart.positions(tried)
    log_weight = seed_quality(pairs, limits).log_prior
    # Gumbel keys: drawing without replacement in proportion to the weights.
    keys = log_weight + rng.gumbel(size=len(pairs))
    kept = pairs[np.sort(np.argsort(-keys, kind="stable")[:num_samples])]
    is_seen = np.isfinite(image_m).all(axis=-1)
    distance = np.sum((kept[..., :2] - image_m)[:, is_seen] ** 2, axis=(1, 2))
    return np.asarray(kept[np.argmin(distance)])
