"""Motion files whose joints fit no known layout: sticks between the files' own joints."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np

from flows.viewing.scene import People, Scene
from flows.viewing.shelf import Shelf
from pasdedeux.arrays import Array
from pasdedeux.errors import InputError, named
from pasdedeux.formats.registry import MOTION_FORMATS, find_format
from pasdedeux.formats.rigs.guess import USUAL_HEIGHT_M, guess_unit
from pasdedeux.formats.rigs.own_joints import OwnJoints, is_body, read_own_joints
from pasdedeux.formats.rigs.resolution import MIN_UNIT_CONFIDENCE, resolve_up_axes
from pasdedeux.formats.source_motion import SourceMotion, upright_from_file
from pasdedeux.kinematics.rotations import rotate
from pasdedeux.projections.sources import resample_positions
from pasdedeux.skeletons import Skeleton
from storage_schema import TABLES, Store, artifact_key
from tasks.ingest.files import load_file, read_start
from tasks.ingest.takes.resolution import find_companion

_RATE_HZ = 30.0
"""Rate of files that state none."""
_ABOUT = "the file's own joints, drawn as sticks: nothing is measured"


@contextmanager
def open_own_joints(files: Sequence[str], units_m: Sequence[float], refused: InputError) -> Iterator[Shelf]:
    """Yield a shelf with one take: the people of motion files that a study would refuse.

    Args:
        files: The files; one with several people may be repeated, each time for the next person.
        units_m: Length of the unit of each file, metres; the last one also for further files; guessed without any.
        refused: Why a study refuses them.

    Raises:
        InputError: `refused`, if the files are bodies of known layouts, or cannot be read.
    """
    paths = list(map(Path, files))
    try:
        read = [_read(path, paths[:at].count(path), is_all=paths.count(path) == 1) for at, path in enumerate(paths)]
    except InputError:
        raise refused from None
    if all(is_known for is_known, _ in read):
        raise refused
    stated = [units_m[min(at, len(units_m) - 1)] if units_m else None for at in range(len(paths))]
    units = [unit for unit, (_, people) in zip(stated, read, strict=True) for _ in people]
    scene = _scene(
        [person for _, people in read for person in people], units, why=f"as a take it is refused: {refused}"
    )
    rows, name = scene.num_frames, paths[0].stem
    columns = {column.name: np.full((rows, *column.shape), np.nan) for column in TABLES["poses"].columns}
    known = {
        "take_id": [name] * rows,
        "person": np.zeros(rows, dtype=np.int64),
        "frame": np.arange(rows),
        "local_unitquat": [np.zeros(0)] * rows,
    }
    with tempfile.TemporaryDirectory() as folder:
        store, stage = Store(Path(folder)), "ingest"
        ref = store.commit(
            stage=stage,
            key=artifact_key(stage=stage, version=1, parameters={"name": name}, input_digests=[], seed=0),
            partition=name,
            name=name,
            version=1,
            parameters={"name": name},
            seed=0,
            inputs=(),
            files=(),
            tables={"poses": {**columns, **known}},
        )
        yield Shelf(store, [ref], scenes={ref: scene})


def _read(path: Path, number: int, *, is_all: bool) -> tuple[bool, list[OwnJoints]]:
    """Return whether a file has bodies of known layouts, and its hierarchies, all or that of a number."""
    with named(path.name):
        kind = find_format(MOTION_FORMATS, "auto", read_start(path))
        companion, data = find_companion(path, kind), load_file(path).data
        beside = load_file(Path(companion.path)).data if companion else b""
        everybody = read_own_joints(kind, data, beside)
        if not is_all and number >= len(everybody):
            raise InputError(f"it holds {len(everybody)}, and is named more often")
        return is_body(kind, data, beside), everybody if is_all else [everybody[number]]


def _unit_m(source: SourceMotion) -> float:
    """Return the length of a file's unit; if unknown, the unit that gives the figure the height of an adult."""
    guess = guess_unit(source)
    is_told = guess.confidence >= MIN_UNIT_CONFIDENCE or not guess.height_m
    return guess.metres_per_unit * (1.0 if is_told else USUAL_HEIGHT_M / guess.height_m)


def _scene(people: Sequence[OwnJoints], units_m: Sequence[float | None], *, why: str) -> Scene:
    """Return the scene of all people, at the lowest rate, cut to the shortest motion."""
    sources, num = [person.source for person in people], len(people)
    axes = resolve_up_axes(sources, [None] * num, ["auto"] * num, [True] * num)
    rate_hz = min(person.rate_hz or _RATE_HZ for person in people)
    placed = []
    for person, source, axis, unit_m in zip(people, sources, axes, units_m, strict=True):
        positions = resample_positions(person.positions, from_hz=person.rate_hz or _RATE_HZ, to_hz=rate_hz)
        upright = rotate(np.broadcast_to(upright_from_file(axis.axis), (*positions.shape[:-1], 4)), positions)
        placed.append(upright * (unit_m or _unit_m(source)))
    shown = _together([person.skeleton for person in people], placed)
    return Scene(shown, np.arange(len(shown.positions_m)), rate_hz, facts=(_ABOUT, why), has_floor=False)


def _together(skeletons: Sequence[Skeleton], placed: Sequence[Array]) -> People:
    """Return people on the union of their skeletons; joints that a person lacks lie at the person's root, unseen."""
    rigs = list(dict.fromkeys(skeletons))
    starts = list(accumulate((rig.num_joints for rig in rigs), initial=0))
    names: list[str] = []
    for at, rig in enumerate(rigs):
        marks = "'" * at
        while any(name + marks in names for name in rig.joint_names):  # a name in a file may have such a mark
            marks += "'"
        names += [name + marks for name in rig.joint_names]
    parents = [
        start + parent if parent >= 0 else (rigs[0].root if start else -1)
        for rig, start in zip(rigs, starts, strict=False)
        for parent in rig.parents
    ]
    positions: Any = np.empty((min(map(len, placed)), len(placed), len(names), 3), dtype=np.float32)
    for person, (rig, joints_m) in enumerate(zip(skeletons, placed, strict=True)):
        start, shown_m = starts[rigs.index(rig)], joints_m[: len(positions)]
        positions[:, person] = shown_m[:, [rig.root]]
        positions[:, person, start : start + rig.num_joints] = shown_m
    return People(Skeleton("own joints", tuple(names), tuple(parents)), positions)
