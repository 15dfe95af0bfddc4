"""Reruns: whether what goes in is as it was, and whether what comes out is - the same bytes, or rounding, or else."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flows.planning import Plan, PlanError
from flows.reasons import shorten
from flows.recorded import Place, Recorded, environment_changes
from storage_schema import Manifest, Store
from storage_schema.comparison import Difference, compare_artifacts

__all__ = ["Comparison", "compare", "environment_lines", "refuse_changed_inputs", "why_it_differs"]


@dataclass(frozen=True)
class Comparison:
    """What two builds of one study differ by: places that only one has, and others in order, what is read first.

    `beyond` is the first place where it is more than rounding; None where it is nowhere.
    """

    num_same: int
    only_one: tuple[Place, ...]
    differing: Mapping[Place, tuple[Difference, ...]]
    beyond: Place | None

    @property
    def is_same(self) -> bool:
        """Tell whether nothing differs by more than rounding."""
        return self.beyond is None and not self.only_one

    @property
    def differs(self) -> bool:
        """Tell whether anything differs at all."""
        return bool(self.differing or self.only_one)

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON values."""
        return {
            "is_same": self.is_same,
            "num_same_bytes": self.num_same,
            "only_in_one": [" ".join(place) for place in self.only_one],
            "first_beyond_rounding": None if self.beyond is None else " ".join(self.beyond),
            "differing": {" ".join(place): [str(one) for one in found] for place, found in self.differing.items()},
        }

    def lines(self) -> list[str]:
        """Return it as lines for people."""
        num_all = self.num_same + len(self.differing)
        lines = [f"same bytes: {self.num_same} of {num_all} artifacts"]
        lines += [f"only in one of the two: {' '.join(place)}" for place in self.only_one[:3]]
        firsts = dict.fromkeys(place for place in (next(iter(self.differing), None), self.beyond) if place is not None)
        for place in firsts:
            name = "first beyond rounding" if place == self.beyond else "first that differs"
            lines.append(f"{name}: {' '.join(place)}")
            worst = sorted(self.differing[place], key=lambda one: -one.excess)
            lines += [f"    {one}" for one in worst[:5]]
        return lines


def refuse_changed_inputs(old: Recorded, plan: Plan) -> None:
    """Refuse files from outside that are not what they were; `plan` is of the old study in the store that has it.

    Raises:
        PlanError: Names the first files that have changed.
    """
    changed = [
        f"{file.path} is not what {old.label} read ({shard.stage} {shard.partition}): its sha256 is {file.sha256[:12]}"
        for stage in plan.stages
        for shard in (item.shard for item in stage.shards)
        for before in [old.artifacts.get((shard.stage, shard.partition, shard.name))]
        for file in shard.files
        if before is not None and (Path(file.path).name, file.sha256) not in before.files
    ]
    if changed:
        more = f", and {len(changed) - 1} more" if len(changed) > 1 else ""
        raise PlanError(f"{changed[0]}{more}; put the old file there, or run the study itself for the new one")


def compare(
    one_store: Store, one: Mapping[Place, Manifest], other_store: Store, other: Mapping[Place, Manifest]
) -> Comparison:
    """Compare two builds artifact by artifact; of those with the same digest nothing is read.

    Attached files (pages, pictures, weights) have no tolerance: other bytes of theirs count as rounding where a table
    before them, or beside them, was rounded otherwise; one that is missing never does.

    Raises:
        CorruptArtifact, SchemaError: A table cannot be read.
    """
    num_same = 0
    differing: dict[Place, tuple[Difference, ...]] = {}
    beyond: Place | None = None
    is_rounded = False
    for place, manifest in one.items():
        if place not in other:
            continue
        found = tuple(compare_artifacts(one_store, manifest, other_store, other[place]))
        if not found:
            num_same += 1
            continue
        differing[place] = found
        is_rounded = is_rounded or any(not difference.is_attachment for difference in found)
        if beyond is None and any(
            d.is_beyond and not (is_rounded and d.is_attachment and not d.is_missing) for d in found
        ):
            beyond = place
    return Comparison(num_same, tuple(sorted(one.keys() ^ other.keys())), differing, beyond)


def environment_lines(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """Return what two builds ran on that differs, a line each: what it was, and what it is in the new one."""
    return [
        f"{name}: {shorten(was) or 'not on record'} -> {shorten(now) or 'none'}"
        for name, (was, now) in environment_changes(old, new).items()
    ]


def why_it_differs(old: Recorded, new: Mapping[Place, Manifest], ran_on: Mapping[str, Any]) -> list[str]:
    """Return what is known to be different and may be why results are; one sentence where nothing is.

    Args:
        old: The build on record.
        new: The artifacts of the new one.
        ran_on: What the new one ran on, as its record says.
    """
    known = [(place, manifest, new[place]) for place, manifest in old.artifacts.items() if place in new]
    changes = [
        f"stage {place[0]} has version {now.version}, it had {was.version}: its results are meant to change"
        for place, was, now in known
        if was.version != now.version
    ]
    changes += [f"{place[0]} {place[1]} read other files" for place, was, now in known if was.files != now.files]
    return [*dict.fromkeys(changes), *environment_lines(old.environment, ran_on)] or [
        "program, packages, processor and settings are as they were: something adds up in an order left to chance, or "
        "reads what is not on record; `pasdedeux verify` tells whether a file was damaged"
    ]
