"""`ridge_scale`: a quadratic in the scales in closed form; for an unseen take, linear in plain forward kinematics.

On a take of its training set, the motion is the source's plus a quadratic in the people's scales whose coefficients are
fitted per frame, joint and axis by ridge regression; at scale 1 it is the source.  An unseen take has no coefficients:
there each joint moves by a fixed mix of how plain forward kinematics moves all joints, the same mix for all takes,
frames and axes (so it turns with the pair), also fitted by ridge regression.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pasdedeux.arrays import Array, merge_axes
from pasdedeux.augmentation import LIMB_GROUPS, reference_motion
from pasdedeux.augmentation.source import complete_scales
from pasdedeux.errors import InputError
from pasdedeux.learning.model import (
    Arrays,
    Config,
    LogEntry,
    Trained,
    Training,
    TrainingItem,
    VariantModel,
    VariantRequest,
    check_arrays,
    check_topology,
    skeleton_of,
)
from pasdedeux.skeletons import BODY22, Skeleton

RIDGE = 3e-3
"""Ridge of a take's quadratic, as a share of the mean diagonal.

Two training scales 5 % off fix the square term exactly, and with it every millimetre the solver left, 16 to 25 times
magnified at 0.75; this shrinks the square term by a fifth and the linear one not at all.
"""
_MIX_RIDGE = 1e-4
"""Ridge of the mix for unseen takes, as a share of the mean diagonal."""


@dataclass
class RidgeScaleModel(VariantModel):
    """Quadratic coefficients of each take it was trained on, and the mix for others.

    Args:
        is_by_group: Features are the scales of each limb group, or of whole people if training varied nothing finer.
        coefficients: Per take (feature, T, 2, 22, 3), metres.
        mix: Share of each joint's plain displacement in that of each joint (44, 44), or of another skeleton's joints.
    """

    name = "ridge_scale"
    is_of_any_skeleton = True

    is_by_group: bool = False
    coefficients: dict[str, Array] = field(default_factory=dict)
    mix: Array = field(default_factory=lambda: np.eye(2 * BODY22.num_joints))

    @property
    def skeleton(self) -> Skeleton:
        """The skeleton that the mix is of."""
        return skeleton_of(self.name, len(self.mix) // 2)

    @classmethod
    def train(cls, training: Training) -> Trained:
        """Fit both parts; reads the items three times and holds one at a time."""
        items = training.items
        is_by_group, num_items, skeleton = False, 0, BODY22
        for item in items():
            num_items += 1
            skeleton = item.request.source.skeleton
            bones = np.delete(item.request.bone_scale, skeleton.root, axis=1)
            is_by_group = is_by_group or bool(np.ptp(bones, axis=1).max() > 1e-6)
        if num_items == 0:
            raise InputError("ridge_scale: there is no variant to train on; check the split and the scales")
        num_points = 2 * skeleton.num_joints
        model = cls(is_by_group=is_by_group, mix=np.eye(num_points))
        sums: dict[str, tuple[Array, Array]] = {}
        gram, moment = np.zeros((2, num_points, num_points))
        for item in items():
            model._add(item, sums)
            plain, change = _displacements(item)
            gram += np.einsum("tia,tja->ij", plain, plain, optimize=True)
            moment += np.einsum("tia,tja->ij", plain, change, optimize=True)
        model.coefficients = {take: _ridge(*both, RIDGE) for take, both in sums.items()}
        flat = _ridge(gram, moment, _MIX_RIDGE)
        model.mix = np.ascontiguousarray(flat.T)
        squared, count, squared_mix = 0.0, 0, 0.0
        for item in items():
            error = np.linalg.norm(model.predict(item.request) - item.motion_m, axis=-1)
            plain, change = _displacements(item)
            mixed = np.linalg.norm(np.einsum("ji,tia->tja", model.mix, plain) - change, axis=-1)
            squared, squared_mix, count = squared + error.sum(), squared_mix + mixed.sum(), count + error.size
        log = [
            LogEntry(0, "num_variants", float(num_items)),
            LogEntry(0, "num_takes", float(len(sums))),
            LogEntry(0, "train_error_cm", 100.0 * squared / count),
            LogEntry(0, "train_error_as_unseen_cm", 100.0 * squared_mix / count),
        ]
        return Trained(model, log)

    def config(self) -> Config:
        """Return the configuration: the kind of features."""
        return {"is_by_group": self.is_by_group}

    def arrays(self) -> dict[str, Array]:
        """Return the mix, and coefficients per take as `take/<take_id>`."""
        return {"mix": self.mix} | {f"take/{take}": values for take, values in self.coefficients.items()}

    @classmethod
    def restore(cls, config: Config, arrays: Arrays, built_on: VariantModel | None = None) -> VariantModel:
        """Make the model from its arrays."""
        takes = {name.removeprefix("take/"): values for name, values in arrays.items() if name.startswith("take/")}
        num_points = len(arrays["mix"]) if np.ndim(arrays.get("mix", 0)) else 2 * BODY22.num_joints
        check_arrays(cls.name, arrays, {"mix": (num_points, num_points)})
        joints = skeleton_of(cls.name, num_points // 2 if num_points % 2 == 0 else 0).num_joints
        model = cls(is_by_group=config.get("is_by_group") is True, coefficients=takes, mix=arrays["mix"])
        shape = (len(model.features(np.ones((2, joints)))), 2, joints, 3)
        of_takes = {f"take/{take}": (shape[0], *values.shape[1:2], *shape[1:]) for take, values in takes.items()}
        check_arrays(cls.name, arrays, of_takes)
        return model

    def predict(self, request: VariantRequest) -> Array:
        """Return the motion: by the take's own quadratic where it was trained on, by the mix elsewhere."""
        check_topology(self, request.source)
        source = request.source.positions_m
        known = self.coefficients.get(request.take_id)
        if known is None:
            plain = _plain_displacement(request)
            return source + np.einsum("ji,tia->tja", self.mix, plain).reshape(source.shape)
        if known.shape[1] != len(source):
            raise InputError(
                f"ridge_scale learned take {request.take_id} with {known.shape[1]} frames, asked for {len(source)}"
            )
        return np.asarray(source + np.tensordot(self.features(request.bone_scale), known, axes=1))

    def features(self, bone_scale: Array) -> Array:
        """Return the quadratic features (feature,) of scales (2, 22): zero at scale 1."""
        names, root = self.skeleton.joint_names, self.skeleton.root
        whole = [[index for index in range(len(names)) if index != root]]
        parts = [[names.index(bone) for bone in bones if bone in names] for bones in LIMB_GROUPS.values()]
        groups = parts if self.is_by_group else whole
        linear = np.array([[person[bones].mean() - 1.0 for bones in groups] for person in bone_scale])
        sizes = linear.mean(axis=1)
        return np.concatenate([linear.ravel(), linear.ravel() ** 2, [sizes[0] * sizes[1]]])

    def _add(self, item: TrainingItem, sums: dict[str, tuple[Array, Array]]) -> None:
        """Add an item to the matrix and the right-hand side of its take's normal equations."""
        features = self.features(item.request.bone_scale)
        change = item.motion_m - item.request.source.positions_m
        take = item.request.take_id
        if take not in sums:
            count = len(features)
            sums[take] = np.zeros((count, count)), np.zeros((count, *change.shape))
        matrix, rhs = sums[take]
        if rhs.shape[1:] != change.shape:
            raise InputError(f"{take}: variants of {rhs.shape[1]} and of {len(change)} frames")
        matrix += np.outer(features, features)
        rhs += features[:, None, None, None, None] * change


def _ridge(gram: Array, moment: Array, share: float) -> Array:
    """Solve (G + ridge) c = m with `moment` (feature, ...); features that never vary get nothing."""
    scale = float(np.trace(gram)) / len(gram)
    if scale <= 0.0:
        return np.zeros(moment.shape)
    regular = gram + share * scale * np.eye(len(gram))
    return np.asarray(np.linalg.solve(regular, moment.reshape(len(gram), -1)).reshape(moment.shape))


def _plain_displacement(request: VariantRequest) -> Array:
    scales = complete_scales(request.source, request.bone_scale[None])
    moved = reference_motion(request.source, scales)[0] - request.source.positions_m
    return merge_axes(moved, 1, -1)


def _displacements(item: TrainingItem) -> tuple[Array, Array]:
    change = item.motion_m - item.request.source.positions_m
    return _plain_displacement(item.request), merge_axes(change, 1, -1)
