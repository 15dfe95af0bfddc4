"""Check motion files one by one without a store: read them as ingest does, judge them as the stages do.

A command runs `check_motion` in other processes, so everything here can be pickled.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
from pyarrow import ArrowException, parquet

from pasdedeux.errors import InputError
from pasdedeux.evaluation.motion_check import CheckedMotion, join_verdicts
from pasdedeux.evaluation.pictures import Picture
from pasdedeux.formats.file_format import FileStart
from pasdedeux.formats.registry import MOTION_FORMATS, find_format
from pasdedeux.people.names import partners_of, take_name
from pasdedeux.plausibility.capture import check_capture, judge_capture
from pasdedeux.skeletons import BODY22
from pasdedeux.verdict import Level, Verdict
from tasks.files.user_files import exported_unit_m, read_file
from tasks.ingest import IngestParameters, plan
from tasks.ingest.files import read_start
from tasks.ingest.takes.run import NO_LIMIT, CapturedTake, capture_take
from tasks.stage import StageInputs

SUFFIXES = tuple(dict.fromkeys(suffix for kind in MOTION_FORMATS.values() for suffix in kind.suffixes))
"""Endings of the files of a folder that are looked at."""
UNREADABLE = "unreadable"
"""The level of a file that cannot be read."""


@dataclass(frozen=True)
class ClipRows:
    """Where the positions of a clip lie in the folder of a dataset (docs/datasets.md)."""

    row_group: int
    num_people: int
    rate_hz: float


@dataclass(frozen=True)
class MotionFiles:
    """A motion that is to be checked.

    Args:
        name: Its name.
        files: Its files, one a person; of a clip of a dataset the Parquet file.
        section: How a study would read the files, as its only take.
        clip: Which rows of the Parquet file it is.
    """

    name: str
    files: tuple[str, ...]
    section: IngestParameters = field(default=IngestParameters(), hash=False)
    clip: ClipRows | None = None


@dataclass(frozen=True)
class Checked:
    """Result of checking a motion.

    Args:
        name: Its name.
        files: Its files.
        level: pass, warn or fail, or unreadable.
        reason: Why.
        figures: How it was read, and all its figures, as JSON values; empty if it cannot be read.
    """

    name: str
    files: tuple[str, ...]
    level: str
    reason: str
    figures: dict[str, Any] = field(default_factory=dict)

    @property
    def verdict(self) -> Verdict:
        """The verdict; a file that cannot be read fails."""
        return Verdict(Level.FAIL if self.level == UNREADABLE else Level(self.level), self.reason)


def files_below(paths: Iterable[Path]) -> list[Path]:
    """Return the given files, and the motion files in given folders by their suffix, sorted.

    Of files in one folder that differ in their suffix alone, such as BVH and npz of an export, the first kind is used.

    Raises:
        InputError: A path does not exist, or nothing is there.
    """
    files: dict[Path, None] = {}
    for path in paths:
        if path.is_dir():
            named = [file for file in sorted(path.rglob("*")) if file.suffix.lower() in SUFFIXES and file.is_file()]
            ranked = sorted(named, key=lambda file: SUFFIXES.index(file.suffix.lower()))
            first = {file.with_suffix(""): file for file in reversed(ranked)}
            files |= dict.fromkeys(sorted(first.values()))
        elif path.exists():
            files[path] = None
        else:
            raise InputError(f"file {path} does not exist")
    if not files:
        raise InputError(f"there are no motion files ({', '.join(SUFFIXES)}) in {', '.join(map(str, paths))}")
    return list(files)


def count_people(path: Path) -> int | str:
    """Return the number of people in a file (0 for a companion of other files), or why it cannot be read."""
    try:
        start = read_start(path)
        if any(kind.is_companion(FileStart(start)) for kind in MOTION_FORMATS.values()):
            return 0
        kind = find_format(MOTION_FORMATS, "auto", start)
        return kind.count_people(read_file(path)) if kind.read_other else 1
    except InputError as error:
        return f"{path.name}: {error}"


def pair_up(
    files: Mapping[Path, int], *, units_m: Sequence[float] = (), rate_hz: float | None = None
) -> list[MotionFiles]:
    """Group files into motions, given the number of people in each; partners are recognised by name.

    If there are only two files, they are partners whatever their names.

    Args:
        files: The files, with the number of people in each.
        units_m: Metres per unit of the files of A, B, ...; the last holds for all after it.  A BVH file exported with
            an npz takes its unit from there.
        rate_hz: True frame rate of all files, where they do not state it.
    """
    alone = [path for path, count in files.items() if count == 1]
    groups: list[tuple[Any, ...]] = [(path,) * count for path, count in files.items() if count > 1]
    groups += [tuple(alone)] if len(alone) == 2 == len(files) else partners_of(alone)
    names = Counter(map(take_name, groups))
    pairs = []
    for group in sorted(groups):
        name = take_name(group)
        name = name if names[name] == 1 else Path(group[0]).with_suffix("").as_posix()
        take_id = re.sub(r"[^A-Za-z0-9_.-]", "_", name).lstrip("_.-")[-100:].lstrip("_.-") or "take"
        units = (
            units_m[min(at, len(units_m) - 1)] if units_m else exported_unit_m(path) for at, path in enumerate(group)
        )
        persons = [{"metres_per_unit": unit} for unit in units]
        take = {"id": take_id, "files": [str(path.resolve()) for path in group], "rate_hz": rate_hz, "persons": persons}
        section = IngestParameters.model_validate({"takes": [take]})
        pairs.append(MotionFiles(name, tuple(map(str, group)), section))
    return pairs


def clips_in_folder(folder: Path) -> list[tuple[MotionFiles, MotionFiles | None]]:
    """Return the clips of a dataset's folder, each variant with its take if present; none for any other folder.

    Raises:
        InputError: Its table of clips cannot be read.
    """
    paths = sorted((folder / "data" / "clips").glob("*.parquet"))
    if not paths:
        return []
    columns = ["clip_id", "take_id", "variant_id", "file", "row_group", "num_people", "rate_hz"]
    try:
        rows = [row for path in paths for row in parquet.read_table(path, columns=columns).to_pylist()]
    except (ArrowException, OSError) as error:
        raise InputError(f"{paths[0].parent}: the clips of this dataset cannot be read: {error}") from None
    clips = {
        row["clip_id"]: MotionFiles(
            row["clip_id"],
            (str(folder / row["file"]),),
            clip=ClipRows(row["row_group"], row["num_people"], row["rate_hz"]),
        )
        for row in rows
    }
    return [(clips[row["clip_id"]], clips.get(row["take_id"]) if row["variant_id"] else None) for row in rows]


def source_of(name: str, sources: Sequence[MotionFiles]) -> MotionFiles | None:
    """Return the source of a motion: the only one, or the one whose name is a prefix of the motion's name.

    >>> source_of("waltz_B-0.80", []) is None
    True
    """
    fitting = [source for source in sources if re.match(rf"{re.escape(source.name)}(?![A-Za-z0-9])", name)]
    return sources[0] if len(sources) == 1 else max(fitting, key=lambda source: len(source.name), default=None)


def check_motion(motion: MotionFiles, original: MotionFiles | None = None) -> Checked:
    """Read a motion and its source, if it has one, and judge them; report why a file cannot be read."""
    try:
        checked, taken, against = _read(motion, original)
        touch, verdicts = checked.touch(), [taken.judged.take, taken.guessed]
        figures: dict[str, Any] = {
            "num_frames": len(taken.people_m),
            "duration_s": len(taken.people_m) / taken.rate_hz,
            "rate_hz": taken.rate_hz,
            "people": [
                {name: getattr(how, name) for name in _HOW_READ if how is not None} | asdict(measured)
                for how, measured in zip_longest(taken.people, taken.figures)
            ],
            **asdict(touch),
        }
        if against is not None:
            quality, held, verdict = checked.held_against(against)
            verdicts.append(verdict)
            figures |= {"source": against.name, "against_source": asdict(quality) | asdict(held)}
    except InputError as error:
        said = str(error)
        for take in motion.section.takes:
            said = said.removeprefix(f"take {take.id}: ")
        return Checked(motion.name, motion.files, UNREADABLE, said)
    judged = join_verdicts(verdicts)
    return Checked(motion.name, motion.files, judged.level.value, judged.reason, _as_json(figures))


def motion_player(motion: MotionFiles, original: MotionFiles | None, checked: Checked) -> Picture:
    """Return the players of a checked motion."""
    shown, taken, against = _read(motion, original)
    said = f"{checked.name}: {checked.level}" + (f": {checked.reason}" if checked.reason else "")
    return shown.picture(said, taken.figures, against)


_HOW_READ = ("source_name", "format", "layout", "rate_hz", "metres_per_unit", "unit_confidence", "up_axis")
"""Reported columns on how each person's file was read."""


def _read(
    motion: MotionFiles, original: MotionFiles | None
) -> tuple[CheckedMotion, CapturedTake, CheckedMotion | None]:
    taken = read_checked_motion(motion)
    against = None if original is None else _original(original)
    return CheckedMotion(motion.name, taken.people_m, taken.rate_hz), taken, against


def read_checked_motion(motion: MotionFiles) -> CapturedTake:
    """Read a motion as the only take of its section, at the rate of its fastest file; a clip as it is.

    Raises:
        InputError: As planning and ingest have it, or the rows of a clip are not those of its people.
    """
    if motion.clip is None:
        return capture_take(plan(StageInputs(manifests={}, seed=0), motion.section)[0])
    people_m = _positions(Path(motion.files[0]), motion.clip)
    figures = check_capture(people_m, rate_hz=motion.clip.rate_hz)
    judged = judge_capture(figures, {**motion.section.capture.limits, "body_difference_m": NO_LIMIT})
    return CapturedTake(people_m, motion.clip.rate_hz, (), tuple(figures), Verdict(Level.PASS), judged)


def _positions(path: Path, clip: ClipRows) -> npt.NDArray[np.float64]:
    """Return the body22 positions (frame, person, 22, 3) of a row group, whatever the order of its rows."""
    try:
        rows = parquet.ParquetFile(path).read_row_group(clip.row_group, columns=["person", "frame", "body22_m"])
        order = np.lexsort((rows["person"].to_numpy(), rows["frame"].to_numpy()))
        flat = rows["body22_m"].combine_chunks().flatten()
        while not pa.types.is_floating(flat.type):
            flat = flat.flatten()
        places = flat.to_numpy().astype(np.float64).reshape(len(order), BODY22.num_joints, 3)
        return places[order].reshape(-1, clip.num_people, BODY22.num_joints, 3)
    except (ArrowException, OSError, ValueError) as error:
        raise InputError(f"{path}: row group {clip.row_group} is no clip of this dataset: {error}") from None


@lru_cache(maxsize=2)
def _original(motion: MotionFiles) -> CheckedMotion:
    """Return a source; consecutive motions mostly share it."""
    taken = read_checked_motion(motion)
    return CheckedMotion(motion.name, taken.people_m, taken.rate_hz)


def _as_json(value: Any) -> Any:
    """Return values as JSON has them: numbers that are not finite become null."""
    if isinstance(value, dict):
        return {key: _as_json(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_as_json(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
