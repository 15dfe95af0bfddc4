"""A layout: how the joints of one kind of motion file become the working skeletons."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from pasdedeux.errors import InputError
from pasdedeux.skeletons.mapping import JointMap
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
        signature: Joints that a file must all have to be recognised as this layout.
        tables: For each working skeleton its table.
        points: Points added to the source.
    """

    name: str
    meaning: str
    signature: frozenset[str]
    tables: Mapping[str, Table] = field(repr=False)
    points: tuple[AddedPoint, ...] = ()

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

    def with_prefix(self, prefix: str) -> Layout:
        """Return this layout for joint names that all carry a namespace in front, such as 'mixamorig:'."""
        added = {point.name for point in self.points}

        def put(name: str) -> str:
            return name if name in added else prefix + name

        def put_entry(entry: Entry) -> Entry:
            return put(entry) if isinstance(entry, str) else {put(name): weight for name, weight in entry.items()}

        return replace(
            self,
            signature=frozenset(put(name) for name in self.signature),
            tables={
                skeleton: {joint: put_entry(entry) for joint, entry in table.items()}
                for skeleton, table in self.tables.items()
            },
            points=tuple(
                replace(point, joint=put(point.joint), unit_bone=put(point.unit_bone)) for point in self.points
            ),
        )
