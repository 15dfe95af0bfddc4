"""Windows of variants or takes to train on: `PairDataset` in any order, `PairStream` shuffled, shared out, resumable.

Torch's loader reads them::

    from pasdedeux.data import PairDataset, PairStream

    windows = PairDataset("variants:duets", window=30)  # of a study in a store, or variants:FOLDER
    for batch in DataLoader(PairStream(windows, batch_size=64), batch_size=None, num_workers=2):
        batch["positions"]  # (64, 30, 2, 22, 3)

Data are first unpacked, once, into a folder of the cache (`storage_schema.unpacked`).
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc

from pasdedeux.errors import InputError, check_whole
from pasdedeux.learning.normalising import Normaliser
from pasdedeux.learning.shuffling import WindowOrder
from pasdedeux.skeletons import BODY22
from storage_schema import Store, parse_reference, resolve
from storage_schema.unpacked import CONTACT, ROWS
from tasks.files.curation import choices_for, names_left_out
from tasks.rows.sides import SplitName, take_sides
from tasks.rows.unpacking import unpack_artifacts, unpack_folder
from tasks.stage.streams import stream

GroupName = Literal["take", "interaction"]
Field = Literal["positions", "rotations", "source", "contacts", "mask", "scales", "skeleton"]
FIELDS: tuple[Field, ...] = get_args(Field)
Batch = dict[str, Any]
Numbers = npt.NDArray[np.int64]

J = BODY22.num_joints
_PLACES = ("num_frames", "num_people", "first_row", "first_source", "first_frame", "first_person")
_ALIGNED = 64
"""Alignment of the arrays of a batch, bytes."""


class PairDataset:
    """Windows of variants or takes: a map-style data set for torch's `DataLoader`, which needs no torch itself.

    An item is a dict of arrays; T is the window, P the number of people, J = 22 the joints of body22:

    - `positions` (T, P, J, 3) in metres, Y up, and `source`, those of the take (of a take the same)
    - `rotations` (T, P, J, 4): local unit quaternions (x, y, z, w) that play it on `skeleton`
    - `contacts` (T, P(P-1)/2, J, J): weights of the take's contacts between the bones of two people, the first with the
      second, then the first and the second with the third, and so on; zero where there is none
    - `mask` (T, P, J), bool: the joint is present; absent joints are zero in `positions` and `rotations`
    - `scales` (P, J): length of each bone beside the take's; `skeleton` (P, J, 3): the rest pose, metres
    - `name` of the clip, `start`, its first frame in it, and `rate_hz`

    Arrays but `mask` are float32.  Several numbers give a batch, with an axis in front; where its windows have unequal
    numbers of people, the places of those who lack are zeros, and false in `mask`.  Items stand in a fixed order; clips
    that failed are left out.  No take is on two sides.  A dataset's folder states the side of each take.  In a store,
    held-out takes are for testing, or a fifth of all takes if none is held out; a tenth of the others, at least one of
    two, is for validation.  With `by="interaction"`, performances of one interaction stay together.

    Args:
        reference: `variants:` or `poses:` (takes) and a study, `study/partition` or `dataset@version` in the store, or
            the path of a folder that `dataset write` wrote.
        window: Frames of an item.
        split: `train`, `validation` or `test`.
        store: Store or its folder.
        stride: Frames from the start of a window to the next; half a window when not given.
        fields: Which arrays an item has: each costs time.
        is_normalised: Subtract mean from positions and source, and divide by deviation, joint by joint: of the training
            side, as `stats.json` of a folder has them.  `normaliser` has both, and undoes it.
        by: Unit that is never split; for a store.
        seed: Decides which takes validate, and test where none is held out; for a store.
        curation: File of choices, else those of the study or dataset: what is rejected is left out, the sides of takes
            stay; for a store.

    Raises:
        InputError: An argument is not allowed, no window is on this side (says why), or the file holds no choices.
        UnknownReference: There is no such study, partition or dataset.
    """

    def __init__(
        self,
        reference: str,
        window: int = 60,
        split: SplitName = "train",
        *,
        store: Store | str | Path = "store",
        stride: int | None = None,
        fields: Collection[Field] = FIELDS,
        is_normalised: bool = False,
        by: GroupName = "take",
        seed: int = 0,
        curation: str | Path | None = None,
    ) -> None:
        table, _, where = reference.partition(":")
        if table not in ("variants", "poses") or not where:
            raise InputError(
                f"'{reference}' is not of variants or takes: name them as variants:study, poses:study, "
                "variants:dataset@version or variants:FOLDER"
            )
        for name, value, allowed in (("split", split, SplitName), ("by", by, GroupName)):
            if value not in get_args(allowed):
                raise InputError(f"{name} is {value!r}; it must be one of {', '.join(get_args(allowed))}")
        if isinstance(fields, str) or not fields or not set(fields) <= set(FIELDS):
            raise InputError(f"fields is {fields!r}; it must be some of {', '.join(FIELDS)}")
        check_whole(window, "window", minimum=1)
        check_whole(seed, "seed", minimum=0)
        self.window, self.stride = int(window), max(1, window // 2) if stride is None else stride
        check_whole(self.stride, "stride", minimum=1)
        self.fields = tuple(name for name in FIELDS if name in fields)
        left_out: list[str] = []
        if (folder := Path(where)).is_dir():
            if (by, seed, curation) != ("take", 0, None):
                raise InputError(f"{folder} says itself which takes stand where: by, seed and curation are for a store")
            self._files = unpack_folder(folder)
        else:
            opened, parsed = store if isinstance(store, Store) else Store(store), parse_reference(reference)
            opened.refresh()
            choices = choices_for(opened, parsed, None if curation is None else Path(curation))
            left_out = [name.replace("/", ", ") for name in names_left_out(opened, parsed, choices)]
            self._files = unpack_artifacts(opened, resolve(parsed, opened))
        clips = self._files.clips()
        sound = _only(_only(clips, "is_variant", [table == "variants"]), "verdict", ["fail"], is_without=True)
        sides = _sides(sound, seed, group="take_id" if by == "take" else "interaction")
        kept = _only(sound, "name", left_out, is_without=True)
        on_side = _only(kept, "take_id", [take for take in sides if sides[take] == split])
        clips = on_side.filter(pc.greater_equal(on_side["num_frames"], self.window))
        if not clips.num_rows:
            raise InputError(f"'{reference}': {_why_no_window(kept, on_side, window, split, by)}")
        self.normaliser = self._make_normaliser(folder, table, kept, sides) if is_normalised else None
        self._names, self._rates_hz = clips["name"].combine_chunks(), clips["rate_hz"].to_numpy().astype(np.float32)
        self._clips, self._is_whole = {name: clips[name].to_numpy() for name in _PLACES}, clips["is_whole"].to_numpy()
        self.counts: Numbers = (self._clips["num_frames"] - self.window) // self.stride + 1
        self._stops = np.cumsum(self.counts)

    def __len__(self) -> int:
        return int(self._stops[-1])

    def __getitem__(self, index: int | Sequence[int] | Numbers) -> Batch:
        """Return an item, or of several numbers a batch; IndexError where there is none of a number."""
        numbers = np.asarray(index, dtype=np.int64)
        if numbers.size and not (-len(self) <= numbers.min() and numbers.max() < len(self)):
            raise IndexError(f"there are {len(self)} windows, none has the number {index}")
        batch = self._read(numbers.reshape(-1) % len(self))
        return batch if numbers.ndim else {name: values[0] for name, values in batch.items()}

    def __getitems__(self, indices: Sequence[int]) -> list[Batch]:
        """Return items that are read together, padded to the same number of people, as `DataLoader` requests them."""
        batch = self[indices]
        return [{name: values[row] for name, values in batch.items()} for row in range(len(indices))]

    def _read(self, numbers: Numbers) -> Batch:
        clip = np.searchsorted(self._stops, numbers, side="right")
        start = (numbers - (self._stops - self.counts)[clip]) * self.stride
        places = {name: column[clip] for name, column in self._clips.items()}
        people, partial = places["num_people"], np.flatnonzero(~self._is_whole[clip])
        is_there = np.arange(people.max(initial=0)) < people[:, None]
        seen = np.broadcast_to(is_there[:, None, :, None], (len(clip), self.window, is_there.shape[1], J))
        first = places["first_row"] + start * people
        if len(partial):
            seen = seen.copy()
            seen[partial] = self._read_people("mask", first[partial], people[partial], seen[partial])
        batch: Batch = self._allocate(len(clip), is_there.shape[1])
        for name, into in batch.items():
            if name == "contacts":
                self._read_contacts(places["first_frame"] + start, start, into)
            elif name == "mask":
                into[:] = seen
            else:
                row = places["first_source"] + start * people if name == "source" else first
                self._read_people("positions" if name == "source" else name, row, people, into)
            if self.normaliser is not None and name in ("positions", "source"):
                self.normaliser.apply(into)
                into *= seen[..., None]
        if {"scales", "skeleton"} & set(self.fields):
            person = places["first_person"][:, None] + np.minimum(np.arange(is_there.shape[1]), people[:, None] - 1)
            bodies = self._files.take("people", person) * is_there[..., None, None]
            arrays = {"scales": bodies[..., 0], "skeleton": bodies[..., 1:]}
            batch |= {name: arrays[name] for name in self.fields if name in arrays}
        labels = {"name": self._names.take(pa.array(clip)).to_pylist(), "start": start, "rate_hz": self._rates_hz[clip]}
        return batch | labels

    def _allocate(self, count: int, widest: int) -> Batch:
        """Return the arrays of a batch that are read, in one piece of memory.

        The C library returns arrays of a few megabytes to the system whenever they are free, and requesting their pages
        again takes longer than filling them.
        """
        frames = (count, self.window)
        forms = {
            name: (ROWS[name].base, (*frames, widest, *ROWS[name].shape)) for name in ("positions", "rotations", "mask")
        }
        forms |= {"source": forms["positions"]}
        forms |= {"contacts": (np.dtype(np.float32), (*frames, widest * (widest - 1) // 2, J, J))}
        forms = {name: forms[name] for name in self.fields if name in forms}
        sizes = [dtype.itemsize * math.prod(shape) for dtype, shape in forms.values()]
        starts = np.cumsum([0, *(-(-size // _ALIGNED) * _ALIGNED for size in sizes)]).tolist()
        memory = np.empty(starts[-1], np.uint8)
        parts = [memory[start : start + size] for start, size in zip(starts, sizes, strict=False)]
        return {
            name: part.view(form[0]).reshape(form[1]) for (name, form), part in zip(forms.items(), parts, strict=True)
        }

    def _read_people(self, name: str, first: Numbers, people: Numbers, into: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Fill `into` (n, frame, person, *row) with the rows of so many people each, from a row on, and zeros."""
        if (people == into.shape[2]).all():
            self._files.read(name, first, into)
            return into
        by_people = [np.empty((self.window, count, *into.shape[3:]), into.dtype) for count in people.tolist()]
        self._files.read(name, first, by_people)
        into[:] = 0
        for rows, some in zip(into, by_people, strict=True):
            rows[:, : some.shape[1]] = some
        return into

    def _read_contacts(self, first: Numbers, start: Numbers, into: npt.NDArray[np.float32]) -> None:
        """Fill `into` (n, frame, pair, J, J) with the weights of frames, numbered through, from `first` on."""
        low, high = self._files.take("first_contacts", first + np.array([[0], [self.window]]))
        stops = np.cumsum(high - low)
        rows = np.empty(int(stops[-1]) if len(stops) else 0, CONTACT)
        bounds = zip((stops - (high - low)).tolist(), stops.tolist(), strict=True)
        self._files.read("contacts", low, (rows[a:b] for a, b in bounds))
        into[:] = 0.0
        frame = rows["frame"] + np.repeat(np.arange(len(first)) * self.window - start, high - low)
        into.reshape(-1)[(frame * into.shape[2] + rows["pair"]) * J**2 + rows["bones"]] = rows["weight"]

    def _make_normaliser(self, folder: Path, table: str, kept: pa.Table, sides: Mapping[str, str]) -> Normaliser:
        if folder.is_dir():
            statistics = (
                json.loads((folder / "stats.json").read_bytes()).get("train", {}).get(table, {}).get("body22_m", {})
            )
            return Normaliser(statistics.get("mean", np.nan), statistics.get("std", np.nan))
        train = _only(kept, "take_id", [take for take in sides if sides[take] == "train"])
        columns = (train[name].to_numpy() for name in ("first_row", "num_frames", "num_people"))
        return Normaliser.of(self._positions(*clip) for clip in zip(*columns, strict=True))

    def _positions(self, first: int, frames: int, people: int) -> npt.NDArray[np.float32]:
        """Return the positions of a clip (n, J, 3), NaN where a joint is not there."""
        positions, mask = (self._files.read_rows(name, first, frames * people) for name in ("positions", "mask"))
        positions[~mask] = np.nan
        return positions


class PairStream:
    """Batches of windows, shuffled, for torch's `DataLoader` with `batch_size=None`, or any loop: an iterable data set.

    An epoch is one order of all windows (`pasdedeux.learning.shuffling`), by seed and epoch alone, cut into batches.
    Ranks take them in turn, and so do the workers of a `DataLoader`: no window comes twice, and any number of workers
    gives the same batches in the same order.  After an epoch comes the next; where workers make the batches,
    `set_epoch` says which, as they begin anew with every epoch.

    Args:
        windows: The windows.
        batch_size: Windows of a batch.
        is_shuffled: Otherwise windows keep their order.
        seed: Decides the order.
        rank: Number of this process among the processes that train together.
        num_ranks: Number of these.
        drops_rest: Leave out the last windows, which fill no batch for each rank; otherwise all windows come, and some
            ranks may have one batch more than others.

    Raises:
        InputError: An argument is not allowed.
    """

    def __init__(
        self,
        windows: PairDataset,
        batch_size: int = 64,
        *,
        is_shuffled: bool = True,
        seed: int = 0,
        rank: int = 0,
        num_ranks: int = 1,
        drops_rest: bool = False,
    ) -> None:
        for name, value, minimum in (("batch_size", batch_size, 1), ("seed", seed, 0), ("num_ranks", num_ranks, 1)):
            check_whole(value, name, minimum=minimum)
        check_whole(rank, "rank", minimum=0)
        if rank >= num_ranks:
            raise InputError(f"rank is {rank}; it must be less than num_ranks, {num_ranks}")
        self.windows, self.batch_size, self.seed, self.is_shuffled = windows, batch_size, seed, is_shuffled
        self.rank, self.num_ranks, self.drops_rest = rank, num_ranks, drops_rest
        self._epoch = self._start = self._next = 0
        if find_spec("torch"):
            from pasdedeux.learning.networks.streaming import register_stream

            register_stream(PairStream)

    def __len__(self) -> int:
        """Return the batches of an epoch of this rank."""
        if self.drops_rest:
            return len(self.windows) // self.batch_size // self.num_ranks
        return -(-(-(-len(self.windows) // self.batch_size) - self.rank) // self.num_ranks)

    def __iter__(self) -> Iterator[Batch]:
        worker, num_workers = _this_worker()
        draw = partial(stream, self.seed, "windows", self._epoch) if self.is_shuffled else None
        order = WindowOrder(self.windows.counts, draw)
        start, self._start = self._start + worker, 0
        for number in range(start, len(self), num_workers):
            at = (self.rank + number * self.num_ranks) * self.batch_size
            self._next = number + num_workers - worker
            yield self.windows[order.windows(at, at + self.batch_size)]
        self._epoch, self._next = self._epoch + 1, 0

    def set_epoch(self, epoch: int) -> None:
        """Begin with this epoch, from 0, when batches are next asked for."""
        self.load_state_dict({"epoch": epoch, "batch": 0})

    def state_dict(self) -> dict[str, int]:
        """Return where the stream is: its epoch, and the batches of this rank that it gave in it.

        Where workers make the batches this object gives none: then count those that came, and load
        `{"epoch": epoch, "batch": count}`.
        """
        return {"epoch": self._epoch, "batch": self._next}

    def load_state_dict(self, state: Mapping[str, int]) -> None:
        """Go on where another stream of the same windows was, with any number of workers.

        Raises:
            InputError: It is no such state.
        """
        if set(state) != {"epoch", "batch"}:
            raise InputError(
                f"the state of a stream has epoch and batch, not {', '.join(map(str, state)) or 'nothing'}"
            )
        for name in state:
            check_whole(state[name], name, minimum=0)
        self._epoch, self._start = state["epoch"], state["batch"]
        self._next = self._start


def _this_worker() -> tuple[int, int]:
    if not find_spec("torch"):
        return 0, 1
    from pasdedeux.learning.networks.streaming import this_worker

    return this_worker()


def _only(clips: pa.Table, column: str, values: Sequence[Any], *, is_without: bool = False) -> pa.Table:
    """Return the clips with one of these values in a column, or those with none of them."""
    is_in = pc.is_in(clips[column], pa.array(values, clips[column].type))
    return clips.filter(pc.invert(is_in) if is_without else is_in)


def _why_no_window(kept: pa.Table, on_side: pa.Table, window: int, split: str, by: str) -> str:
    """Return why the variants of a side have no window of so many frames."""
    if not kept.num_rows:
        return "every variant failed, or is left out by the choices"
    if not on_side.num_rows:
        return f"none of the {kept.num_rows} variants is on the side {split}, split by {by}"
    longest = pc.max(on_side["num_frames"]).as_py()
    whose = f"the {on_side.num_rows} variants on the side {split}"
    return f"the longest of {whose} has {longest} frames, fewer than the window of {window}"


def _sides(clips: pa.Table, seed: int, *, group: str) -> dict[str, SplitName]:
    """Return the side of each take; takes whose group is tested are on none."""
    rows = clips.group_by(list({"take_id": 0, "is_held_out": 0, "split": 0, group: 0})).aggregate([]).to_pylist()
    if rows and rows[0]["split"]:
        return {row["take_id"]: row["split"] for row in rows}
    tested = {row[group] for row in rows if row["is_held_out"]}
    drawn = take_sides({row[group]: row[group] in tested for row in rows}, seed)
    sides: dict[str, SplitName] = {}
    for row in rows:
        if row["is_held_out"]:
            sides[row["take_id"]] = "test"
        elif row[group] not in tested:
            sides[row["take_id"]] = drawn[row[group]].split
    return sides
