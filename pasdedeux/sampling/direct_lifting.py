"""Pairs lifted from 2D alone: seeds for sampling without any 3D data of the takes.

Bone lengths come from the annotations: over many views each bone appears nearly unforeshortened in some; a bone that
none shows has its usual proportion.  The torso is lifted with the torso basis; what remains is discrete: either twin of
each torso, towards or away from the camera for each limb bone, and the relative depth of the people.  Joint limits
choose among the 256 poses of a person's limbs, the estimated view and penetration among twins and depths. Joints that
are not seen are first estimated in the image: those of the torso where the lifted one has them, those of limbs by the
seen part of the limb.  A lifted pair has an error of 8-11 cm on captured dancers; growth (`growth.grow`) then reduces
it by comparing pairs.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array
from pasdedeux.cameras.frames import angle_between_directions, pair_frame
from pasdedeux.cameras.torso import TORSO_INDICES, TorsoBasis, lift_torsos
from pasdedeux.errors import InputError
from pasdedeux.interaction.nearest import image_distances
from pasdedeux.kinematics.rotations import normalise
from pasdedeux.plausibility.joint_limits import JointLimits
from pasdedeux.sampling.annotations import AnnotatedPairs
from pasdedeux.sampling.growth_kernels import place_near_image
from pasdedeux.sampling.parameters import gauge_fix
from pasdedeux.sampling.prior import DEFAULT_PRIOR, PriorSettings
from pasdedeux.sampling.seeds import seed_quality
from pasdedeux.skeletons import PAIR17
from pasdedeux.skeletons.humanoid import t_pose
from pasdedeux.spread import evenly_spread

Indices = npt.NDArray[np.int64]

LENGTH_PERCENTILE = 70.0
"""Percentile of a bone's length in the image that counts as its length: foreshortening makes it too short, noise and
errors of scale too long; on captured dancers it is right to 5 % with 1 cm of noise and to 3 % without."""
VIEW_DEVIATION_RAD = 0.15
"""Error of an estimated view, radians."""
FORWARD_PER_M = 3.0
"""Preference for hands or feet in front of their shoulder or hip, log probability per metre."""
PENETRATION_SHARE = 0.05
"""Share of eq. 2's penetration used to choose depths: in full it would outweigh the view in every embrace."""
TIGHTNESS = 0.16
"""Weight of a squared error in depth against one in the image when bones are placed."""

_BODY22_NAMES = {"spine": "spine1", "chest": "spine3"}


def _usual_lengths() -> Array:
    """Return bone lengths (17,) of an average body, fractions of its height (T-pose of `body22`)."""
    places = np.array([t_pose(_BODY22_NAMES.get(name, name)) for name in PAIR17.joint_names])
    lengths = np.linalg.norm(places - places[_PARENTS], axis=-1)
    lengths[PAIR17.root] = 0.0
    return np.asarray(lengths)


_MAX_ROUNDS = 30
_DEPTHS_M = np.linspace(-0.9, 0.9, 19)
_NUM_GROUPED = 500
"""Number of annotations that are grouped to choose those to lift; the cost grows with its square."""
_NUM_WEIGHED = 12
_NUM_TRIES = 8
_ORDER, _PARENTS = np.array(PAIR17.order), np.array(PAIR17.parents)
_LIMBS = PAIR17.limbs
_PELVIS, _SPINE, _CHEST, _NECK, _HEAD = PAIR17.indices(("pelvis", "spine", "chest", "neck", "head"))
_DOWN = np.array([1.0, -1.0])
_USUAL_LENGTHS = _usual_lengths()
_SIGNS = np.array(list(itertools.product((1.0, -1.0), repeat=2 * len(_LIMBS))))


@dataclass(frozen=True)
class LiftedSeeds:
    """Seeds lifted from annotations.

    Args:
        pairs_m: Pairs (seed, person=2, joint=17, 3), metres, gauge-fixed; upright if the camera was level.
        entry: Entry of the annotated pairs that each was lifted from, (seed,).
        log_prior: Log of eq. 2 (Yin et al. 2018), (seed,).
    """

    pairs_m: Array
    entry: Indices
    log_prior: Array


def apparent_bone_lengths(points_m: Array) -> Array:
    """Return bone lengths (person=2, joint=17), metres, from images (n, person=2, joint=17, 2), metres, of many views.

    Left and right get the mean of the two; a root's length is 0.  A bone counts in the images that show both its ends
    (NaN where a joint is not seen).  A bone that no image shows, on neither side of the body, has its usual proportion
    to those of the person that are seen: a close-up has no lower legs.

    Raises:
        InputError: No image shows any bone of a person; names the person.
    """
    flat = np.linalg.norm(points_m - points_m[:, :, _PARENTS], axis=-1)
    flat[..., PAIR17.root] = 0.0
    either = np.concatenate([flat, flat[..., list(PAIR17.mirror)]])
    is_known = np.isfinite(either).any(axis=0)
    is_seen = np.isfinite(flat).any(axis=0)
    shown = np.where(is_seen, flat, either[len(flat) :])
    lengths = np.nanpercentile(np.where(is_known, shown, 0.0), LENGTH_PERCENTILE, axis=0)
    for person in range(2):
        seen = is_known[person] & (_USUAL_LENGTHS > 0)
        if not seen.any():
            raise InputError(f"no annotation shows a bone of person {'AB'[person]}: its size is not known")
        scale = lengths[person, seen].sum() / _USUAL_LENGTHS[seen].sum()
        lengths[person, ~is_known[person]] = scale * _USUAL_LENGTHS[~is_known[person]]
    lengths = 0.5 * (lengths + lengths[:, list(PAIR17.mirror)])
    return np.asarray(lengths)


def lift_pair(
    image_m: Array,
    direction: Array,
    lengths_m: Array,
    limits: JointLimits,
    basis: TorsoBasis,
    prior: PriorSettings = DEFAULT_PRIOR,
) -> Array | None:
    """Return the likeliest pair (person=2, joint=17, 3), metres, camera axes, of one image; None without torsos.

    Args:
        image_m: Image points (person=2, joint=17, 2), metres, x right, y up; NaN where a joint is not seen.
        direction: Estimated view in the pair's local frame, (3,).
        lengths_m: Bone lengths (person=2, joint=17), metres.
        limits: Joint limits.
        basis: Torso basis, of other takes.
        prior: Weights of eq. 2; the defaults when not given.
    """
    torsos = lift_torsos(image_m[:, TORSO_INDICES] * _DOWN, basis)
    if not torsos.is_lifted.all():
        return None
    people = []
    for person in range(2):
        torso_m = torsos.torso_m[person]
        flat = (
            torso_m[..., :2] / torsos.metres_per_pixel[person, :, None, None] + torsos.root_px[person, :, None] * _DOWN
        )
        image = _completed(image_m[person], flat.mean(axis=0), lengths_m[person])
        people.append([_lift_person(image, torso, lengths_m[person], limits, prior) for torso in torso_m])
    pairs, costs = [], []
    for (first, cost_of_first), (second, cost_of_second) in itertools.product(*people):
        placed = np.stack([np.broadcast_to(pose, (len(_DEPTHS_M), 17, 3)) for pose in (first, second)], axis=1)
        placed[:, 1, :, 2] += _DEPTHS_M[:, None]
        pairs.append(placed)
        costs.append(np.full(len(placed), cost_of_first + cost_of_second))
    pair, cost = np.concatenate(pairs), np.concatenate(costs)
    seen = pair_frame(pair).coordinates(np.broadcast_to(np.array([0.0, 0.0, 1.0]), (len(pair), 3)))
    cost = cost + 0.5 * (angle_between_directions(seen, direction) / VIEW_DEVIATION_RAD) ** 2
    likeliest = np.argsort(cost, kind="stable")[:_NUM_WEIGHED]
    weighed = cost[likeliest] - PENETRATION_SHARE * seed_quality(pair[likeliest], limits, prior).log_prior
    return np.asarray(pair[likeliest[int(np.argmin(weighed))]])


def lift_seeds(
    annotated: AnnotatedPairs,
    limits: JointLimits,
    basis: TorsoBasis,
    *,
    num_seeds: int,
    prior: PriorSettings = DEFAULT_PRIOR,
) -> LiftedSeeds:
    """Lift annotations that cover all of them: the medoids of `num_seeds` groups under d_I.

    Args:
        annotated: Annotated pairs, each under its likeliest view alone.
        limits: Joint limits.
        basis: Torso basis, of other takes.
        num_seeds: Seeds asked for; where a medoid gives no possible pair the annotation nearest to it is taken.  There
            are fewer if no such pair is possible, or if there are fewer annotations.
        prior: Weights of eq. 2; the defaults when not given.

    Raises:
        InputError: No annotation gives a possible pair.
    """
    count = len(annotated.points_m)
    lengths = apparent_bone_lengths(annotated.points_m)
    shown = evenly_spread(count, max(_NUM_GROUPED, num_seeds))
    matrix = _distances(annotated.points_m[shown])
    lifted: list[Array] = []
    used: list[int] = []
    for medoid in choose_medoids(matrix, min(num_seeds, count)):
        near = [int(index) for index in np.argsort(matrix[medoid], kind="stable") if index not in used]
        for index in near[:_NUM_TRIES]:
            entry = int(shown[index])
            pair = lift_pair(annotated.points_m[entry], annotated.directions[entry], lengths, limits, basis, prior)
            if pair is not None and seed_quality(pair[None], limits, prior).is_possible[0]:
                lifted.append(gauge_fix(pair))
                used.append(index)
                break
    if not lifted:
        raise InputError(f"no seed can be lifted from 2D alone: no pair of {count} annotations keeps the joint limits")
    pairs = np.array(lifted)
    return LiftedSeeds(pairs_m=pairs, entry=shown[used], log_prior=seed_quality(pairs, limits, prior).log_prior)


def _distances(images_m: Array) -> Array:
    """Return d_I between all images, (n, n), metres; images that share too little get the largest distance."""
    matrix = image_distances(images_m, images_m)
    matrix = np.where(np.isfinite(matrix), matrix, np.nanmax(matrix))
    # Symmetric to the bit, so that the first of a group of two represents both.
    return np.minimum(matrix, matrix.T)


def choose_medoids(matrix: Array, count: int) -> Indices:
    """Return `count` medoids (count,) of a set with these dissimilarities (set, set).

    Farthest-first from the member nearest to all others, then Voronoi iteration: everyone joins the nearest medoid, and
    each group takes the member nearest to the rest of it, until nothing changes.  No randomness; ties go to the lower
    index.  `count` is at least 1, and at most the size of the set.
    """
    chosen = [int(np.argmin(matrix.sum(axis=1)))]
    while len(chosen) < count:
        distance = matrix[chosen].min(axis=0)
        distance[chosen] = -1.0
        chosen.append(int(np.argmax(distance)))
    medoids = np.array(chosen, dtype=np.int64)
    for _ in range(_MAX_ROUNDS):
        group = np.argmin(matrix[medoids], axis=0)
        group[medoids] = np.arange(count)
        moved = medoids.copy()
        for index in range(count):
            members = np.flatnonzero(group == index)
            moved[index] = members[np.argmin(matrix[np.ix_(members, members)].sum(axis=1))]
        if (moved == medoids).all():
            break
        medoids = moved
    return medoids


def _completed(image_m: Array, torso_m: Array, lengths_m: Array) -> Array:
    """Return an image (17, 2) with a guess where no joint is seen (NaN).

    Args:
        image_m: The image, metres.
        torso_m: Image of the lifted torso, (6, 2), metres.
        lengths_m: Bone lengths, (17,), metres.

    A head extends the backbone, an elbow or knee is half-way, a hand or foot extends its limb straight, and a limb of
    which nothing is seen hangs down along the body.
    """
    image = image_m.copy()

    def guess(joint: int, place: Array) -> None:
        if not np.isfinite(image[joint]).all():
            image[joint] = place

    for joint, place in zip(TORSO_INDICES, torso_m, strict=True):
        guess(int(joint), place)
    back = image[_NECK] - image[_PELVIS]
    along = np.cumsum(lengths_m[[_SPINE, _CHEST, _NECK, _HEAD]])
    per_metre = back / max(float(along[2]), 1e-9)
    for joint, length in ((_SPINE, along[0]), (_CHEST, along[1]), (_HEAD, along[3])):
        guess(joint, image[_PELVIS] + length * per_metre)
    for root, middle, end in _LIMBS:
        halfway = 0.5 * (image[root] + image[end])
        guess(middle, halfway if np.isfinite(halfway).all() else image[root] - lengths_m[middle] * per_metre)
        ahead = (image[middle] - image[root]) / max(float(lengths_m[middle]), 1e-9)
        guess(end, image[middle] + lengths_m[end] * ahead)
    return image


def _lift_person(
    image_m: Array, torso_m: Array, lengths_m: Array, limits: JointLimits, prior: PriorSettings
) -> tuple[Array, float]:
    """Return the likeliest of 256 poses of a person's limbs, (17, 3), pelvis at depth 0, and its cost."""
    up = normalise(torso_m[1] - torso_m[0])
    across = torso_m[2] - torso_m[3]
    forward = np.cross(normalise(across - (across @ up) * up), up)
    depth = np.zeros((len(_SIGNS), PAIR17.num_joints))
    depth[:, TORSO_INDICES] = torso_m[:, 2] - torso_m[0, 2]
    along = np.cumsum(lengths_m[[_SPINE, _CHEST, _NECK]])
    depth[:, [_SPINE, _CHEST]] = along[:2] / max(float(along[2]), 1e-9) * depth[:, [_NECK]]
    depth[:, _HEAD] = depth[:, _NECK] + lengths_m[_HEAD] * up[2]
    flat = np.linalg.norm(image_m - image_m[_PARENTS], axis=-1)
    reach = np.sqrt(np.maximum(lengths_m**2 - flat**2, 0.0))
    for limb, (root, middle, end) in enumerate(_LIMBS):
        depth[:, middle] = depth[:, root] + _SIGNS[:, 2 * limb] * reach[middle]
        depth[:, end] = depth[:, middle] + _SIGNS[:, 2 * limb + 1] * reach[end]
    poses = np.empty((len(_SIGNS), PAIR17.num_joints, 3))
    images = np.ascontiguousarray(np.broadcast_to(image_m, (len(_SIGNS), *image_m.shape)))
    lengths = np.ascontiguousarray(np.broadcast_to(lengths_m, depth.shape))
    place_near_image(images, depth, lengths, _ORDER, _PARENTS, np.full_like(depth, TIGHTNESS), poses)
    cost = -prior.log_prior(limits.nearest_valid(poses).squared_distance_m2)
    for root, _, end in _LIMBS:
        cost = cost - FORWARD_PER_M * ((poses[:, end] - poses[:, root]) @ forward)
    best = int(np.argmin(cost))
    return poses[best], float(cost[best])
