"""A layout: how the joints of one kind of motion file become the working skeletons."""

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
"""What each joint of a working skeleton is made of."""


@dataclass(frozen=True)
class AddedPoint:
    """A point that the source has no joint for, carried rigidly by one of its joints.

    Args:
        name: Name by which the tables of the layout refer to it.
        joint: Joint that carries it.
        offset: Place in the frame of that joint, in lengths of the bone that ends in `unit_bone`.
        unit_bone: Joint whose bone gives the unit, so that the point follows the size of the person.
    """

    name: str
    joint: str
    offset: tuple[float, float, float]
    unit_bone: str


@dataclass(frozen=True)
class Layout:
    """The joint names of one kind of motion file and their meaning.

    What the working joints stand for is the same in every layout.  The `head` of body22 and pair17 is the point at ear
    height on the line of the neck; the `head` of op14 is the nose, which is what 2D detectors report.  The `neck` of
    op14 is the middle of the shoulders, as detectors are trained; that of pair17 lies between it and the neck's base.
    The pelvis of pair17 is the middle of the hips; spine and chest lie near one and two thirds of the way to the neck.
    body22 tables use points that keep their distance from their parent, so its bones keep their lengths.

    Args:
        name: Name of the layout, as a study says it.
        meaning: One line for people.
        tables: For each working skeleton its table; none where that takes the joints of a file, see `fit_layout`.
        points: Points added to the source.
        parts: What the layout calls the joints of body22, and `skull`, `spine`, `chest` and `nose`; `A|B` is A, or B
            where there is no A.
        keeps_axes: Points are in the frames of joints whatever the rest pose is; else in those of a person who stands
            along Y and looks along Z at rest.
        is_whole: A file needs every part of it.
        derived: Joints of body22 that the file has no joint for, and that are placed by those that it has.
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
    """Return the tables of the working skeletons of all parts of a body: the joints of body22, spine, chest, nose."""
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
