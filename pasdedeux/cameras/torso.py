"""The torso: its low-rank basis, and 3D torsos from their 2D joints.

Yin et al. (2018) take the backbones for their view estimate from a lifted torso.  The torso is nearly planar, so a
weak-perspective image determines its scale and its turn up to one twin: the torso mirrored in depth.  Both are
returned.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from pasdedeux.arrays import Array, Flags, merge_axes
from pasdedeux.errors import InputError
from pasdedeux.kinematics import best_rotation, bone_lengths
from pasdedeux.kinematics.rotations import normalise, rotmat_from_unitquat, unitquat_from_rotvec
from pasdedeux.skeletons import PAIR17

TORSO_JOINTS = ("pelvis", "neck", "left_shoulder", "right_shoulder", "left_hip", "right_hip")
TORSO_INDICES = PAIR17.indices(TORSO_JOINTS)
MIN_TORSO_JOINTS = 4
"""Smallest number of seen joints of a torso that is lifted."""

NOISE_SHARE = 0.05
"""Standard deviation of a 2D joint as a share of the torso's extent in the image (root mean square, about 0.25 m)."""

_SIZE_BONES = PAIR17.indices(("spine", "chest", "neck", "left_shoulder", "right_shoulder", "left_hip", "right_hip"))
_NUM_COMPONENTS = 4
_NUM_ITERATIONS = 20
BLOCK_SIZE = 4096


@dataclass(frozen=True)
class TorsoBasis:
    """A torso as a mean and a few components: torso = mean + sum of coefficient x component.

    Args:
        mean_m: Mean torso, (6, 3), metres: pelvis at the origin, y along the backbone, x to the left, z forward.
        components_m: Orthonormal components, (component, 6, 3).
        standard_deviation_m: Standard deviation of each coefficient, (component,), metres.
        explained_variance: Share of the variance that each component explains, (component,).
    """

    mean_m: Array
    components_m: Array
    standard_deviation_m: Array
    explained_variance: Array

    def __post_init__(self) -> None:
        """Check shapes."""
        count, joints = len(self.components_m), len(TORSO_JOINTS)
        if self.mean_m.shape != (joints, 3) or self.components_m.shape != (count, joints, 3):
            raise InputError(f"torso basis: shapes {self.mean_m.shape} and {self.components_m.shape} are not (6, 3)")
        if self.standard_deviation_m.shape != (count,) or self.explained_variance.shape != (count,):
            raise InputError("torso basis: one standard deviation and one variance share per component are needed")


@dataclass(frozen=True)
class LiftedTorsos:
    """3D torsos of n images, each with its twin mirrored in depth.

    Args:
        torso_m: Joints in camera axes (x right, y up, z towards the camera), pelvis at the origin, (n, twin=2, 6, 3),
            metres.  Twin 0 has the neck no further from the camera than twin 1.
        metres_per_pixel: Scale of the person, (n, twin).
        root_px: Pelvis in the image, fitted (also where it was not seen), x right, y down, (n, twin, 2).
        log_scale_deviation: Standard deviation of the logarithm of the scale, from the curvature of the fit, (n, twin).
        is_lifted: Whether enough joints were seen, (n,); other values are NaN if not.
    """

    torso_m: Array
    metres_per_pixel: Array
    root_px: Array
    log_scale_deviation: Array
    is_lifted: Flags

    @property
    def backbones(self) -> Array:
        """Vectors from pelvis to neck, (n, twin, 3), metres."""
        return np.asarray(self.torso_m[..., 1, :] - self.torso_m[..., 0, :])


def learn_torso_basis(pair17_m: Array) -> TorsoBasis:
    """Learn the torso basis from poses (*batch, joint=17, 3) of any number of people, metres.

    Each torso is scaled to the mean size (sum of its bone lengths, which motion does not change) and turned onto the
    mean (Procrustes), so that neither size nor direction is learned.
    """
    poses = np.asarray(pair17_m, dtype=np.float64).reshape(-1, PAIR17.num_joints, 3)
    if len(poses) < 10:
        raise InputError(f"torso basis: at least 10 poses are needed, found {len(poses)}")
    size = bone_lengths(PAIR17, poses)[:, _SIZE_BONES].sum(axis=-1)
    torsos = poses[:, TORSO_INDICES] - poses[:, TORSO_INDICES[:1]]
    torsos = torsos * (size.mean() / size)[:, None, None]
    torsos = np.einsum("nij,nkj->nki", np.swapaxes(_own_axes(torsos), -1, -2), torsos)
    mean = torsos.mean(axis=0)
    for _ in range(10):
        torsos = np.einsum("nij,nkj->nki", best_rotation(torsos, np.broadcast_to(mean, torsos.shape)), torsos)
        mean = torsos.mean(axis=0)
        upright = _own_axes(mean[None])[0].T
        mean, torsos = mean @ upright.T, torsos @ upright.T
    flat = merge_axes(torsos - mean, 1)
    _, singular, components = np.linalg.svd(flat, full_matrices=False)
    variance = singular**2 / max(len(flat) - 1, 1)
    total = max(float(variance.sum()), 1e-300)
    components = components[:_NUM_COMPONENTS]
    # The sign of a component is free: make its largest entry positive, so that a rerun gives the same basis.
    greatest = np.take_along_axis(components, np.argmax(np.abs(components), axis=1)[:, None], axis=1)
    components = components * np.where(greatest < 0, -1.0, 1.0)
    return TorsoBasis(
        mean_m=mean,
        components_m=components.reshape(-1, len(TORSO_JOINTS), 3),
        standard_deviation_m=np.sqrt(variance[:_NUM_COMPONENTS]),
        explained_variance=variance[:_NUM_COMPONENTS] / total,
    )


def lift_torsos(torso_px: Array, basis: TorsoBasis, *, weights: Array | None = None) -> LiftedTorsos:
    """Lift 2D torsos: rotation, weak-perspective scale and coefficients of the basis that fit them, for both twins.

    The mean torso's plane gives a closed form for both twins (an affine map of a plane is a scaled rotation in two
    ways); Levenberg-Marquardt over all torsos at once refines rotation, scale and coefficients from there.

    Args:
        torso_px: Joints in the order of `TORSO_JOINTS`, (n, 6, 2), pixels, x right, y down; NaN where missing.
        basis: Basis learned from other takes.
        weights: Weight of each joint, (n, 6), such as its confidence; 1 when not given.
    """
    given = np.ones(torso_px.shape[:2]) if weights is None else np.asarray(weights, dtype=np.float64)
    # Torsos are independent; blocks keep the memory small.
    parts = [
        _lift_block(torso_px[start : start + BLOCK_SIZE], given[start : start + BLOCK_SIZE], basis)
        for start in range(0, max(len(torso_px), 1), BLOCK_SIZE)
    ]
    names = [field.name for field in fields(LiftedTorsos)]
    return LiftedTorsos(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


def _lift_block(torso_px: Array, weights: Array, basis: TorsoBasis) -> LiftedTorsos:
    seen = np.asarray(np.isfinite(torso_px).all(axis=-1))
    weight = np.where(seen, weights, 0.0)
    num_seen = (weight > 0).sum(axis=-1)
    image = np.where(seen[..., None], torso_px, 0.0) * np.array([1.0, -1.0])
    total = np.maximum(weight.sum(axis=-1), 1e-12)[:, None, None]
    centre = (weight[..., None] * image).sum(axis=1, keepdims=True) / total
    image = np.where(weight[..., None] > 0, image - centre, 0.0)
    extent = np.sqrt((weight[..., None] * image**2).sum(axis=(-1, -2)) / total[:, 0, 0])
    plane = np.broadcast_to(basis.mean_m, (len(image), *basis.mean_m.shape))
    plane = plane - (weight[..., None] * plane).sum(axis=1, keepdims=True) / total
    gram = np.einsum("nj,njc,njd->ncd", weight / total[:, 0], plane[..., :2], plane[..., :2])
    spread = np.linalg.eigvalsh(gram)[:, 0]
    # Joints of the mean torso on one line (within 2 cm) do not determine the turn about that line.
    is_lifted = (num_seen >= MIN_TORSO_JOINTS) & (extent > 0) & (spread > 0.02**2)
    rows = np.flatnonzero(is_lifted)
    lifted = _TorsoFit(image[rows] / extent[rows, None, None], weight[rows], basis)
    lifted.start(plane[rows], gram[rows])
    lifted.refine()
    shape = (len(image), 2)
    out = LiftedTorsos(
        torso_m=np.full((*shape, len(TORSO_JOINTS), 3), np.nan),
        metres_per_pixel=np.full(shape, np.nan),
        root_px=np.full((*shape, 2), np.nan),
        log_scale_deviation=np.full(shape, np.nan),
        is_lifted=is_lifted,
    )
    torso = lifted.torso()
    root = lifted.root() * extent[rows, None, None] + centre[rows]
    order = np.argsort(-(torso[:, :, 1, 2] - torso[:, :, 0, 2]), axis=1, kind="stable")
    each = np.arange(len(rows))[:, None]
    out.torso_m[rows] = (torso - torso[:, :, :1])[each, order]
    out.metres_per_pixel[rows] = (np.exp(-lifted.log_scale) / extent[rows, None])[each, order]
    out.root_px[rows] = (root * np.array([1.0, -1.0]))[each, order]
    out.log_scale_deviation[rows] = lifted.log_scale_deviation()[each, order]
    return out


class _TorsoFit:
    """All torsos and both twins at once; the image is centred and of extent 1, y up."""

    def __init__(self, image: Array, weight: Array, basis: TorsoBasis) -> None:
        self.image = image[:, None]
        self.basis = basis
        self.share = weight / np.maximum(weight.sum(axis=-1, keepdims=True), 1e-12)
        self.root_weight = np.sqrt(weight)[:, None, :, None] / NOISE_SHARE
        self.coefficients = np.zeros((len(image), 2, len(basis.components_m)))
        self.rotmat = np.zeros((len(image), 2, 3, 3))
        self.log_scale = np.zeros((len(image), 2))

    def start(self, plane: Array, gram: Array) -> None:
        """Closed form: the affine map of the mean torso's plane, as a scaled rotation in its two ways."""
        weighted = np.einsum("nj,njc,njd->ncd", self.share, self.image[:, 0], plane[..., :2])
        affine = weighted @ np.linalg.inv(gram)
        scale = np.linalg.svd(affine, compute_uv=False)[:, 0]
        flat = affine / scale[:, None, None]
        lift_x = np.sqrt(np.maximum(1.0 - (flat[:, :, 0] ** 2).sum(-1), 0.0))
        lift_y = np.sqrt(np.maximum(1.0 - (flat[:, :, 1] ** 2).sum(-1), 0.0))
        lift_y = np.where((flat[:, :, 0] * flat[:, :, 1]).sum(-1) > 0, -lift_y, lift_y)
        for twin, sign in enumerate((1.0, -1.0)):
            x = np.concatenate([flat[:, :, 0], sign * lift_x[:, None]], axis=-1)
            y = np.concatenate([flat[:, :, 1], sign * lift_y[:, None]], axis=-1)
            x, y = normalise(x), normalise(y - (x * y).sum(-1, keepdims=True) * x)
            self.rotmat[:, twin] = np.stack([x, y, np.cross(x, y)], axis=-1)
        self.log_scale[:] = np.log(scale)[:, None]

    def refine(self) -> None:
        """Levenberg-Marquardt with a damping for each torso."""
        damping = np.full(self.log_scale.shape, 1e-2)
        best = self.cost()
        for _ in range(_NUM_ITERATIONS):
            residual, jacobian = self._linearise()
            normal = np.einsum("ntri,ntrj->ntij", jacobian, jacobian)
            gradient = np.einsum("ntri,ntr->nti", jacobian, residual)
            diagonal = np.einsum("ntii->nti", normal)
            damped = normal + np.eye(normal.shape[-1]) * (damping[..., None] * (diagonal + 1e-6))[..., None, :]
            step = -np.linalg.solve(damped, gradient[..., None])[..., 0]
            kept = (self.rotmat.copy(), self.log_scale.copy(), self.coefficients.copy())
            turn = rotmat_from_unitquat(unitquat_from_rotvec(step[..., :3]))
            self.rotmat = turn @ self.rotmat
            self.log_scale = self.log_scale + np.clip(step[..., 3], -0.5, 0.5)
            self.coefficients = self.coefficients + step[..., 4:]
            cost = self.cost()
            is_better = cost < best
            self.rotmat = np.where(is_better[..., None, None], self.rotmat, kept[0])
            self.log_scale = np.where(is_better, self.log_scale, kept[1])
            self.coefficients = np.where(is_better[..., None], self.coefficients, kept[2])
            best = np.where(is_better, cost, best)
            damping = np.where(is_better, damping * 0.3, damping * 5.0)

    def shape(self) -> Array:
        return self.basis.mean_m + np.einsum("ntk,kjd->ntjd", self.coefficients, self.basis.components_m)

    def torso(self) -> Array:
        return np.asarray(np.einsum("ntij,ntkj->ntki", self.rotmat, self.shape()))

    def _centred(self, points: Array) -> Array:
        return np.asarray(points - np.einsum("nj,ntjd->ntd", self.share, points)[:, :, None])

    def root(self) -> Array:
        """The pelvis in the centred image of extent 1, (n, twin, 2)."""
        return np.asarray(self._centred(self.torso())[:, :, 0, :2] * np.exp(self.log_scale)[..., None])

    def cost(self) -> Array:
        seen = self._centred(self.torso())[..., :2] * np.exp(self.log_scale)[..., None, None]
        weighted = (seen - self.image) * self.root_weight
        deviation = self.coefficients / np.maximum(self.basis.standard_deviation_m, 1e-6)
        return np.asarray(0.5 * ((weighted**2).sum(axis=(-1, -2)) + (deviation**2).sum(axis=-1)))

    def log_scale_deviation(self) -> Array:
        """Square root of the scale's entry in the inverse of the normal matrix."""
        _, jacobian = self._linearise()
        normal = np.einsum("ntri,ntrj->ntij", jacobian, jacobian)
        # A turn that the image does not show (of a torso seen edge-on) must not make the matrix singular: 1 radian at
        # most.
        inverse = np.linalg.inv(normal + np.diag([1.0, 1.0, 1.0] + [1e-9] * (normal.shape[-1] - 3)))
        return np.sqrt(inverse[..., 3, 3])

    def _linearise(self) -> tuple[Array, Array]:
        torso = self._centred(self.torso())
        scale = np.exp(self.log_scale)[..., None, None]
        residual = (torso[..., :2] * scale - self.image) * self.root_weight
        x, y, z = np.moveaxis(torso, -1, 0)
        zero = np.zeros_like(x)
        # d(rotation) = w x torso: the image columns of (w_x, w_y, w_z).
        turn = np.stack([np.stack([zero, z, -y], -1), np.stack([-z, zero, x], -1)], axis=-2)
        turned = np.einsum("ntij,kqj->ntqik", self.rotmat[..., :2, :], self.basis.components_m)
        bent = turned - np.einsum("nq,ntqik->ntik", self.share, turned)[:, :, None]
        columns = (
            np.concatenate([turn, torso[..., :2, None], bent], axis=-1) * scale[..., None] * self.root_weight[..., None]
        )
        num_coefficients = self.coefficients.shape[-1]
        deviation = np.maximum(self.basis.standard_deviation_m, 1e-6)
        prior = np.concatenate([np.zeros((num_coefficients, 4)), np.diag(1.0 / deviation)], axis=1)
        flat = columns.reshape(*columns.shape[:2], 2 * columns.shape[2], columns.shape[-1])
        jacobian = np.concatenate([flat, np.broadcast_to(prior, (*flat.shape[:2], *prior.shape))], axis=2)
        all_residuals = np.concatenate(
            [residual.reshape(*residual.shape[:2], flat.shape[2]), self.coefficients / deviation], axis=-1
        )
        return all_residuals, jacobian


def _own_axes(torsos: Array) -> Array:
    """Return the axes of torsos (n, 6, 3) as columns: x to the left, y from pelvis to neck, z forward."""
    y = normalise(torsos[:, 1] - torsos[:, 0])
    left = torsos[:, 2] - torsos[:, 3] + torsos[:, 4] - torsos[:, 5]
    x = normalise(left - (left * y).sum(-1, keepdims=True) * y)
    return np.stack([x, y, np.cross(x, y)], axis=-1)
