"""A skeleton: named joints in a tree."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

from pasdedeux.errors import InputError


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
        order = [self.parents.index(-1)]
        for joint in order:
            order.extend(self.children(joint))
        return tuple(order)

    @cached_property
    def bones(self) -> tuple[tuple[int, int], ...]:
        """All (parent, child) pairs, by child index."""
        return tuple((parent, child) for child, parent in enumerate(self.parents) if parent >= 0)

    def children(self, joint: int) -> tuple[int, ...]:
        """Return the indices of a joint's children."""
        return tuple(child for child, parent in enumerate(self.parents) if parent == joint)

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
        """Shoulder, elbow and wrist of the left arm and of the right one; an InputError where there are none."""
        left, right = ([f"{side}_{name}" for name in ("shoulder", "elbow", "wrist")] for side in ("left", "right"))
        return self.indices(left), self.indices(right)

    @cached_property
    def legs(self) -> tuple[list[int], list[int]]:
        """Hip, knee and ankle of the left leg and of the right one; an InputError where there are none."""
        left, right = ([f"{side}_{name}" for name in ("hip", "knee", "ankle")] for side in ("left", "right"))
        return self.indices(left), self.indices(right)

    @property
    def limbs(self) -> tuple[list[int], list[int], list[int], list[int]]:
        """Left arm, right arm, left leg, right leg, each from its root outward."""
        return (*self.arms, *self.legs)

    @cached_property
    def mirror(self) -> tuple[int, ...]:
        """Index of each joint's left/right counterpart (`left_` against `right_`); itself where there is none."""
        swapped = {"left_": "right_", "right_": "left_"}

        def counterpart(name: str) -> str:
            for side, other in swapped.items():
                if name.startswith(side):
                    return other + name.removeprefix(side)
            return name

        return tuple(
            self.joint_names.index(counterpart(name)) if counterpart(name) in self.joint_names else index
            for index, name in enumerate(self.joint_names)
        )
