"""A layout: the mapping from the joints of one kind of motion file to the working skeletons."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

from pasdedeux.errors import InputError
from pasdedeux.skeletons.mapping import JointMap
from pasdedeux.skeletons.skeleton import ARM, LEG, by_side
from pasdedeux.skeletons.working import WORKING_SKELETONS

Entry = str | Mapping[str, float]
"""A source joint, or source joints with weights that sum to 1."""
Table = Mapping[str, Entry]
"""Entry of each joint of a working skeleton."""


@dataclass(frozen=True)
class AddedPoint:
    """A point that is fixed to a joint of the source, where the source has no joint.

    Args:
        name: Its name in the tables of the layout.
        joint: The joint that carries it.
        offset: Position in the frame of that joint, in lengths of the bone that ends in `unit_bone`.
        unit_bone: Joint whose bone is the unit, so that the point scales with the person.
    """

    name: str
    joint: str
    offset: tuple[float, float, float]
    unit_bone: str


@dataclass(frozen=True)
class Layout:
    """The joint names of one kind of motion file and their meaning.

    The meaning of the working joints is the same in all layouts.  The `head` of body22 and pair17 is the point at ear
    height on the line of the neck; the `head` of op14 is the nose, as reported by 2D detectors.  The `neck` of op14 is
    the middle of the shoulders, as in training data of detectors; that of pair17 is between it and the neck's base.
    The pelvis of pair17 is the middle of the hips; spine and chest are near one and two thirds of the way to the neck.
    Tables of body22 use points of constant distance from their parent, so its bones keep their lengths.

    Args:
        name: Name of the layout in a study.
        meaning: One line for people.
        tables: Table of each working skeleton; empty if that needs the joints of a file, see `fit_layout`.
        points: Points added to the source.
        parts: Names in the layout of the joints of body22, and of `skull`, `spine`, `chest` and `nose`; `A|B` is A, or
            B if there is no A.
        keeps_axes: Whether points are in the frames of joints for any rest pose; else in those of a person who stands
            along Y and looks along Z at rest.
        is_whole: Whether a file needs all parts.
        derived: Joints of body22 that the file lacks and that are derived from others.
    """

    name: str
    meaning: str
    tables: Mapping[str, Table] = field(repr=False)
    points: tuple[AddedPoint, ...] = ()
    parts: Mapping[str, Entry] = field(default_factory=dict, repr=False)
    keeps_axes: bool = False
    is_whole: bool = False
    derived: tuple[str, ...] = ()

    def joint_map(self, skeleton_name: str) -> JointMap:
        """Return the mapping to a working skeleton: pair17, op14 or body22.

        Raises:
            InputError: The skeleton is not known, or its table is missing, incomplete or does not sum to 1.
        """
        if skeleton_name not in self.tables:
            raise InputError(f"layout '{self.name}' has no table for '{skeleton_name}'")
        return JointMap(
            name=f"{self.name}.{skeleton_name}",
            target=WORKING_SKELETONS[skeleton_name],
            table=self.tables[skeleton_name],
        )

    def with_tables(self, tables: Mapping[str, Table]) -> Layout:
        """Return this layout with single entries of its tables replaced."""
        for name in tables:
            if name not in WORKING_SKELETONS:
                raise InputError(
                    f"mapping '{self.name}': '{name}' is not a working skeleton; known: {', '.join(WORKING_SKELETONS)}"
                )
        merged = {name: {**self.tables.get(name, {}), **tables.get(name, {})} for name in {**self.tables, **tables}}
        return replace(self, tables=merged)


def working_tables(parts: Mapping[str, Entry]) -> dict[str, Table]:
    """Return the tables of the working skeletons from all parts of a body: joints of body22, spine, chest, nose."""
    shared = {joint: parts[joint] for joint in by_side("left", *ARM, *LEG)}
    shoulders, hips = (mixed((parts[joint], 0.5) for joint in by_side("left", part)) for part in ("shoulder", "hip"))
    neck = mixed([(parts["neck"], 0.4), (shoulders, 0.6)])
    return {
        "pair17": {**shared, "pelvis": hips, "spine": parts["spine"], "chest": parts["chest"], "neck": neck}
        | {"head": parts["head"]},
        "op14": {**shared, "head": parts["nose"], "neck": shoulders},
        "body22": {joint: parts[joint] for joint in WORKING_SKELETONS["body22"].joint_names},
    }


def mixed(shares: Iterable[tuple[Entry, float]]) -> dict[str, float]:
    """Return the weighted sum of entries."""
    total: dict[str, float] = {}
    for entry, share in shares:
        for name, weight in ({entry: 1.0} if isinstance(entry, str) else entry).items():
            total[name] = total.get(name, 0.0) + share * weight
    return total
