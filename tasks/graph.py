"""The graph of stages: found in this package, ordered by the tables they declare to read and write."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from graphlib import CycleError, TopologicalSorter

import tasks
from pasdedeux.settings import Settings
from tasks.files.curation import CurationSettings
from tasks.stage import Parameters, Stage

_NO_STAGE = "shards"
"""Modules without a stage that are slow to import."""


class GraphError(Exception):
    """The declared reads and writes do not form a graph that can be run."""


@dataclass(frozen=True)
class Graph:
    """Stages in topological order: each comes after those that write its inputs.

    Raises:
        GraphError: Two stages have one name or write one table, a stage reads a table that a stage of the graph
            can never have written (a cycle), or nothing writes a table that is read.
    """

    stages: tuple[Stage, ...]
    upstream: dict[str, tuple[str, ...]] = field(init=False)

    def __post_init__(self) -> None:
        """Order the stages and refuse cycles."""
        by_name: dict[str, Stage] = {}
        writer: dict[str, str] = {}
        for stage in self.stages:
            if stage.name in by_name:
                raise GraphError(f"two stages are named '{stage.name}'")
            by_name[stage.name] = stage
            for table in stage.writes:
                if table in writer:
                    raise GraphError(f"table '{table}' is written by two stages, '{writer[table]}' and '{stage.name}'")
                writer[table] = stage.name
        needs = {
            stage.name: {writer[table] for table in stage.reads if table in writer and writer[table] != stage.name}
            for stage in self.stages
        }
        for stage in self.stages:
            resting = _resting(stage.name, needs)
            for other in self.stages if stage.adds_to else ():
                if other is not stage and other.name not in resting and set(stage.adds_to).intersection(other.reads):
                    needs[other.name].add(stage.name)
        for stage in self.stages:
            if any(table in stage.tables for table in stage.reads):
                raise GraphError(f"stage '{stage.name}' reads a table that it writes itself")
        try:
            order = _stable_order([stage.name for stage in self.stages], needs)
        except CycleError as error:
            raise GraphError(f"the stages form a cycle: {' -> '.join(error.args[1])}") from None
        object.__setattr__(self, "stages", tuple(by_name[name] for name in order))
        object.__setattr__(self, "upstream", {n: tuple(m for m in order if m in needs[n]) for n in order})

    @property
    def names(self) -> tuple[str, ...]:
        """Return the stages' names in the order they run."""
        return tuple(stage.name for stage in self.stages)

    @property
    def reporting(self) -> tuple[str, ...]:
        """Return the names of the stages that make a page of all results."""
        return tuple(stage.name for stage in self.stages if "scores" in stage.writes)

    @property
    def shared(self) -> dict[str, type[Settings]]:
        """Return the models of the sections that stages of this graph share, by name.

        Such a section belongs to no stage: every stage whose parameters have its settings receives them.
        """
        from pasdedeux.sampling.prior import PriorSettings  # imported here: --help need not wait for compiled kernels

        sections: dict[str, type[Settings]] = {"physical_prior": PriorSettings, "curation": CurationSettings}
        return {
            name: model
            for name, model in sections.items()
            if any(issubclass(stage.parameters, model) for stage in self.stages)
        }

    def stage(self, name: str) -> Stage:
        """Return the stage of this name, or a GraphError that lists the known ones."""
        for stage in self.stages:
            if stage.name == name:
                return stage
        raise GraphError(f"unknown stage '{name}'; known stages: {', '.join(self.names)}")

    def needed(self, name: str, parameters: Parameters) -> tuple[str, ...]:
        """Return the stages, in order, whose tables a stage reads with these parameters of its own."""
        stage = self.stage(name)
        read = set(stage.reads).difference(() if stage.unread is None else stage.unread(parameters))
        return tuple(other for other in self.upstream[name] if read.intersection(self.stage(other).tables))

    def above(self, name: str) -> frozenset[str]:
        """Return the names of every stage whose results can reach this one."""
        self.stage(name)
        return frozenset(_resting(name, {stage: set(above) for stage, above in self.upstream.items()}))

    def below(self, name: str) -> frozenset[str]:
        """Return the names of every stage that this one's results can reach."""
        return frozenset(other for other in self.names if name in self.above(other))

    def only(self, names: Iterable[str]) -> Graph:
        """Return the graph of these stages alone; tables of the others are then absent."""
        wanted = set(names)
        for name in sorted(wanted):
            self.stage(name)
        return Graph(tuple(stage for stage in self.stages if stage.name in wanted))


def load_graph() -> Graph:
    """Import every stage of this package (a module with a `STAGE`) and return their graph."""
    stages: list[Stage] = []
    for module in pkgutil.iter_modules(tasks.__path__):
        if module.name == _NO_STAGE:
            continue
        stage = getattr(importlib.import_module(f"tasks.{module.name}"), "STAGE", None)
        if isinstance(stage, Stage):
            stages.append(stage)
    return Graph(tuple(stages))


def _resting(name: str, needs: dict[str, set[str]]) -> set[str]:
    """Return the stages that a stage depends on, directly or not."""
    resting: set[str] = set()
    todo = [name]
    while todo:
        new = needs[todo.pop()] - resting
        resting |= new
        todo += new
    return resting


def _stable_order(names: Sequence[str], needs: dict[str, set[str]]) -> list[str]:
    """Order names so that each follows its needs; ties are broken alphabetically, so the order never varies."""
    sorter = TopologicalSorter({name: needs[name] for name in sorted(names)})
    sorter.prepare()
    order: list[str] = []
    while sorter.is_active():
        ready = sorted(sorter.get_ready())
        order.extend(ready)
        sorter.done(*ready)
    return order
