"""A skeleton: named joints in a tree."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Self

from pasdedeux.errors import InputError

ARM = ("shoulder", "elbow", "wrist")
LEG = ("hip", "knee", "ankle")
_OTHER_SIDE = {"left": "right", "right": "left"}


def by_side(first: str, *joints: str) -> tuple[str, ...]:
    """Return names of joints of both sides, `left` or `right` first, one side after the other."""
    return tuple(f"{side}_{joint}" for side in (first, _OTHER_SIDE[first]) for joint in joints)


def by_joint(first: str, *joints: str) -> tuple[str, ...]:
    """Return names of joints of both sides, one joint after the other, its `left` or `right` first."""
    return tuple(f"{side}_{joint}" for joint in joints for side in (first, _OTHER_SIDE[first]))


@dataclass(frozen=True)
class Skeleton:
    """Named joints in a tree; a bone is named by its child joint.

    Args:
        name: Name of the skeleton, used in messages.
        joint_names: Joint names, each once.
        parents: Index of each joint's parent, -1 for the single root.  A parent may come after its child.

    Raises:
        InputError: A name twice, no or several roots, an unknown parent or a cycle.
    """

    name: str
    joint_names: tuple[str, ...]
    parents: tuple[int, ...]

    def __post_init__(self) -> None:
        """Check that the joints form one tree."""
        if len(self.joint_names) != len(self.parents):
            raise InputError(
                f"skeleton '{self.name}': {len(self.joint_names)} joint names but {len(self.parents)} parents"
            )
        repeated = sorted({name for name in self.joint_names if self.joint_names.count(name) > 1})
        if repeated:
            raise InputError(f"skeleton '{self.name}': joint names must be unique; repeated: {', '.join(repeated)}")
        roots = [name for name, parent in zip(self.joint_names, self.parents, strict=True) if parent == -1]
        if len(roots) != 1:
            raise InputError(f"skeleton '{self.name}': exactly one root is needed, found {len(roots)}: {roots}")
        bad = [p for p in self.parents if not -1 <= p < len(self.parents)]
        if bad:
            raise InputError(f"skeleton '{self.name}': parent index {bad[0]} is outside 0..{len(self.parents) - 1}")
        if len(self.order) != len(self.parents):
            raise InputError(f"skeleton '{self.name}': the parents form a cycle")

    @classmethod
    def of_tree(cls, name: str, tree: Mapping[str, str]) -> Self:
        """Return the skeleton with these joints, each with its parent (empty for the root)."""
        joint_names = tuple(tree)
        return cls(name, joint_names, tuple(joint_names.index(parent) if parent else -1 for parent in tree.values()))

    @property
    def num_joints(self) -> int:
        """Number of joints."""
        return len(self.joint_names)

    @cached_property
    def root(self) -> int:
        """Index of the root."""
        return self.parents.index(-1)

    @cached_property
    def order(self) -> tuple[int, ...]:
        """Joint indices from the root outwards, every parent before its children."""
        return tuple(self.branch(self.root))

    @cached_property
    def bones(self) -> tuple[tuple[int, int], ...]:
        """All (parent, child) pairs, by child index."""
        return tuple((parent, child) for child, parent in enumerate(self.parents) if parent >= 0)

    def children(self, joint: int) -> tuple[int, ...]:
        """Return the indices of a joint's children."""
        return self._children[joint]

    def branch(self, joint: int) -> list[int]:
        """Return a joint and all joints below it, every parent before its children."""
        branch = [joint]
        for parent in branch:
            branch.extend(self.children(parent))
        return branch

    def path(self, joint: int) -> list[int]:
        """Return the joints from the root to a joint, both included."""
        path = [joint]
        while self.parents[path[0]] >= 0:
            path.insert(0, self.parents[path[0]])
        return path

    @cached_property
    def _children(self) -> tuple[tuple[int, ...], ...]:
        children: list[list[int]] = [[] for _ in self.parents]
        for child, parent in enumerate(self.parents):
            if parent >= 0:
                children[parent].append(child)
        return tuple(map(tuple, children))

    def index(self, joint_name: str) -> int:
        """Return the index of a joint, or an InputError that lists the known ones."""
        try:
            return self.joint_names.index(joint_name)
        except ValueError:
            known = ", ".join(self.joint_names)
            raise InputError(f"joint '{joint_name}' is not in skeleton '{self.name}'; known joints: {known}") from None

    def indices(self, joint_names: Iterable[str]) -> list[int]:
        """Return the indices of several joints."""
        return [self.index(name) for name in joint_names]

    @cached_property
    def arms(self) -> tuple[list[int], list[int]]:
        """Shoulder, elbow and wrist of the left and the right arm; an InputError if there are none."""
        return self._both_sides(ARM)

    @cached_property
    def legs(self) -> tuple[list[int], list[int]]:
        """Hip, knee and ankle of the left and the right leg; an InputError if there are none."""
        return self._both_sides(LEG)

    def _both_sides(self, joints: tuple[str, ...]) -> tuple[list[int], list[int]]:
        left = self.indices(by_side("left", *joints))
        return left[: len(joints)], left[len(joints) :]

    @property
    def limbs(self) -> tuple[list[int], list[int], list[int], list[int]]:
        """Left arm, right arm, left leg, right leg, each from its root outward."""
        return (*self.arms, *self.legs)

    @cached_property
    def mirror(self) -> tuple[int, ...]:
        """Index of each joint's left/right counterpart (`left_` and `right_`); its own index if there is none."""
        names = self.joint_names
        split = (name.partition("_") for name in names)
        others = [f"{_OTHER_SIDE.get(side, side)}_{joint}" for side, _, joint in split]
        return tuple(names.index(other) if other in names else index for index, other in enumerate(others))
