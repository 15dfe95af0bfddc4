"""Joint limits learned from capture and united with the published table: valid is what either of them allows.

The plain form, over batches; `learned_limits_kernel` has the same for one pose at a time, compiled.  Hinge angles count
only where positions determine them: the table's ranges of nearly straight limbs are wide (`joint_limits`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from pasdedeux.kinematics.rotations import rotmat_from_unitquat, swing_between
from pasdedeux.plausibility.joint_limits import JointLimits, NearestValid
from pasdedeux.plausibility.occupancy import (
    BONES,
    KIND_OF_BONE,
    NUM_CELLS,
    Occupancy,
    bone_cells,
    bone_directions,
    sphere_cells,
)
from pasdedeux.plausibility.ranges import ANGLES
from pasdedeux.skeletons import PAIR17

__all__ = ["ANGLES_OF_BONE", "LIMIT_BONES", "LearnedLimits"]

Array = npt.NDArray[np.float64]

_INDEX = {(angle.joint, angle.angle): index for index, angle in enumerate(ANGLES)}
_SIDES = ("left", "right")
LIMIT_BONES: tuple[tuple[str, str, tuple[tuple[str, str], tuple[str, str]]], ...] = (
    ("spine", "chest", (("spine", "flexion"), ("spine", "lateral"))),
    ("chest", "neck", (("chest", "flexion"), ("chest", "lateral"))),
    ("neck", "head", (("neck", "flexion"), ("neck", "lateral"))),
    *((f"{s}_shoulder", f"{s}_elbow", ((f"{s}_shoulder", "extension"), (f"{s}_shoulder", "crossing"))) for s in _SIDES),
    *((f"{s}_elbow", f"{s}_wrist", ((f"{s}_shoulder", "rotation"), (f"{s}_elbow", "flexion"))) for s in _SIDES),
    *((f"{s}_hip", f"{s}_knee", ((f"{s}_hip", "flexion"), (f"{s}_hip", "abduction"))) for s in _SIDES),
    *((f"{s}_knee", f"{s}_ankle", ((f"{s}_hip", "rotation"), (f"{s}_knee", "flexion"))) for s in _SIDES),
)
"""Joint that a bone turns about, joint it ends in, its two angles; in the order of `bone_directions`."""
ANGLES_OF_BONE = np.array([[_INDEX[angle] for angle in angles] for _, _, angles in LIMIT_BONES])
"""Indices in `ANGLES` of the two angles of each bone, (bone=11, 2)."""


@dataclass(frozen=True)
class LearnedLimits:
    """The table's ranges of every angle, and where bones were seen to point.

    Args:
        table: Ranges of the angles, published or widened.
        occupancy: Counts of captured poses.
    """

    table: JointLimits
    occupancy: Occupancy

    def invalid_angles(self, pair17_m: Array) -> npt.NDArray[np.bool_]:
        """Tell which angles (*batch, 29) of poses (*batch, joint=17, 3) neither table nor capture allows."""
        invalid = self.table.invalid_angles(pair17_m)
        above, cell = bone_cells(bone_directions(pair17_m))
        seen = self.occupancy.occupied[KIND_OF_BONE, above, cell]
        for bone, angles in enumerate(ANGLES_OF_BONE):
            invalid[..., angles] &= ~seen[..., [bone]]
        return invalid

    def num_invalid(self, pair17_m: Array) -> npt.NDArray[np.int64]:
        """Count the angles out of range of poses (*batch, joint=17, 3); gives (*batch,)."""
        return np.asarray(self.invalid_angles(pair17_m).sum(axis=-1))

    def is_valid(self, pair17_m: Array) -> npt.NDArray[np.bool_]:
        """Tell which poses (*batch, joint=17, 3) have every angle in range."""
        return np.asarray(self.num_invalid(pair17_m) == 0)

    def nearest_valid(self, pair17_m: Array) -> NearestValid:
        """Return valid poses near poses (*batch, joint=17, 3), bone by bone from the root outward.

        Shoulders, hips and the twist of the trunk move to the table's limit; every other bad bone to the centre of the
        nearest cell that table or capture allows, which is up to half a cell (5 degrees) more than it must move.
        """
        given = np.asarray(pair17_m, dtype=np.float64)
        poses = self.girdles.nearest_valid(given.reshape(-1, PAIR17.num_joints, 3)).positions
        cells = sphere_cells(NUM_CELLS)
        for bone, (pivot, end, _) in enumerate(LIMIT_BONES):
            directions = bone_directions(poses)
            above, cell = bone_cells(directions)
            kind = int(KIND_OF_BONE[bone])
            seen = self.occupancy.occupied[kind, above[:, bone], cell[:, bone]]
            is_bad = self.table.invalid_angles(poses)[:, ANGLES_OF_BONE[bone]].any(axis=1) & ~seen
            rows = np.flatnonzero(is_bad)
            if not len(rows):
                continue
            nearness = np.where(self.allowed[kind, above[rows, bone]], directions.own[rows, bone] @ cells.T, -2.0)
            target = cells[nearness.argmax(axis=1)]
            frame = directions.frame[rows, bone]
            start = np.einsum("ni,nij->nj", directions.own[rows, bone], frame)
            turn = rotmat_from_unitquat(swing_between(start, np.einsum("ni,nij->nj", target, frame)))
            moved = np.array(_subtree(end))
            centre = poses[rows, PAIR17.index(pivot)][:, None]
            vectors = poses[rows[:, None], moved] - centre
            poses[rows[:, None], moved] = np.einsum("nij,nkj->nki", turn, vectors) + centre
            if end == "chest":
                # The twist of the trunk is measured along it, so it has changed.
                poses = self.girdles.nearest_valid(poses).positions
        num_invalid = self.num_invalid(given)
        positions = np.where((num_invalid == 0)[..., None, None], given, poses.reshape(given.shape))
        return NearestValid(
            positions=positions,
            num_invalid=num_invalid,
            squared_distance_m2=np.asarray(((positions - given) ** 2).sum(axis=(-1, -2))),
        )

    @cached_property
    def girdles(self) -> JointLimits:
        """The table with every angle of a bone free."""
        lower, upper = self.table.lower_rad.copy(), self.table.upper_rad.copy()
        lower[ANGLES_OF_BONE], upper[ANGLES_OF_BONE] = -2.0 * np.pi, 2.0 * np.pi
        return JointLimits(lower_rad=lower, upper_rad=upper, source=self.table.source)

    @cached_property
    def allowed(self) -> npt.NDArray[np.bool_]:
        """Whether table or capture allows a cell, given the cell of the bone above, (7, 60, 500)."""
        return np.asarray(self.occupancy.occupied | self._table_cells[:, None])

    @cached_property
    def _table_cells(self) -> npt.NDArray[np.bool_]:
        """Whether the table allows the centre of each cell, (7, 500): a standing figure points its left bones there."""
        poses = np.broadcast_to(_standing(), (NUM_CELLS, PAIR17.num_joints, 3))
        frames = bone_directions(poses).frame
        allowed = np.zeros((len(BONES), NUM_CELLS), dtype=bool)
        for kind in range(len(BONES)):
            bone = int(np.argmax(kind == KIND_OF_BONE))
            pivot, end = (PAIR17.index(name) for name in LIMIT_BONES[bone][:2])
            pointed = poses.copy()
            pointed[:, _subtree(LIMIT_BONES[bone][1])] += (
                pointed[:, [pivot]]
                + 0.2 * np.einsum("ci,cij->cj", sphere_cells(NUM_CELLS), frames[:, bone])[:, None]
                - pointed[:, [end]]
            )
            allowed[kind] = ~self.table.invalid_angles(pointed)[:, ANGLES_OF_BONE[bone]].any(axis=1)
        return allowed


def _subtree(joint: str) -> list[int]:
    found = [PAIR17.index(joint)]
    for index in found:
        found.extend(PAIR17.children(index))
    return found


def _standing() -> Array:
    """Return an upright figure (17, 3) with arms out and legs hanging: only its frames matter."""
    pose = np.zeros((PAIR17.num_joints, 3))
    place = {
        **{"spine": (0.0, 0.1), "chest": (0.0, 0.2), "neck": (0.0, 0.4), "head": (0.0, 0.6)},
        **{"shoulder": (0.2, 0.3), "elbow": (0.5, 0.3), "wrist": (0.8, 0.3)},
        **{"hip": (0.1, -0.05), "knee": (0.1, -0.5), "ankle": (0.1, -0.9)},
    }
    for name in PAIR17.joint_names[1:]:
        x, y = place[name.removeprefix("left_").removeprefix("right_")]
        pose[PAIR17.index(name)] = (-x if name.startswith("right_") else x, y, 0.0)
    return pose
