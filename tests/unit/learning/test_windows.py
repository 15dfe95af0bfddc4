"""Windows for training: content, sharing between ranks and workers, resuming a stream, and memory."""

from __future__ import annotations

import ast
import json
import pickle
import re
import subprocess
import sys
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks import loader
from flows.console.app import run_command_line
from pasdedeux.errors import InputError
from pasdedeux.learning.normalising import Normaliser
from pasdedeux.learning.shuffling import WindowOrder
from storage_schema import TABLES, CorruptArtifact, Store, open_table
from tasks.data import Data
from tasks.rows.unpacking import unpack_artifacts
from tasks.windows import FIELDS, PairDataset, PairStream
from tests.builders.drawn_stores import Drawn, drawn_store
from tests.builders.notebooks import run_notebook
from tests.builders.storage_rows import put
from tests.builders.stored_datasets import put_clips
from tests.builders.toy_runs import ROOT

pytestmark = pytest.mark.usefixtures("own_cache")
SEED = 7
"""With it the shortest take validates."""
TAKES = [
    Drawn("waltz", 13, False, ("pass", "fail", "warn")),
    Drawn("hug", 9, False, ("pass", "pass"), num_people=3),
    Drawn("push", 4, False, ("pass",)),
    Drawn("", 11, True, ("pass", "warn")),
    Drawn("lift", 12, False, ("pass", "pass", "pass"), has_holes=True),
]


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Store:
    return drawn_store(str(tmp_path_factory.mktemp("store")), TAKES)[0]


@pytest.fixture
def windows(store: Store) -> PairDataset:
    return PairDataset("variants:drawn", 5, store=store, stride=2, seed=SEED)


def test_variants_that_have_other_frames_than_their_take_are_refused_with_the_remedy(tmp_path: Path) -> None:
    store = Store(tmp_path / "store")
    take, solved = put_clips(store, "waltz", 1, 30, ["v0"])
    for num_frames in (20, 40):
        misfit = put_clips(store, f"of {num_frames} frames", 1, num_frames, ["v0"])[1]
        tables = {
            table: {column.name: store.read(misfit.ref, table)[column.name] for column in TABLES[table].columns}
            for table in ("variants", "variant_quality")
        }
        wrong = put(store, "augmentation", f"wrong {num_frames}", tables, dict(solved.facts), (take,))
        with pytest.raises(InputError, match=r"take waltz do not have its 30 frames; build them again with --force"):
            unpack_artifacts(store, [wrong.ref])
    assert unpack_artifacts(store, [solved.ref])


def places(batches: Any) -> list[tuple[str, int]]:
    return [place for batch in batches for place in zip(batch["name"], batch["start"].tolist(), strict=True)]


def plain_window(store: Store, name: str, start: int, window: int, widest: int) -> dict[str, Any]:
    """Return a window, read from whole tables in loops."""
    take_id, _, variant_id = name.partition(", ")
    rows = open_table(f"variants:drawn/{take_id}", store)
    poses, people = (open_table(f"{table}:drawn/{take_id}", store) for table in ("poses", "takes"))
    quality = open_table(f"variant_quality:drawn/{take_id}", store)
    count = people.num_rows
    sizes = {"positions": 3, "rotations": 4, "source": 3}
    wanted = {name: np.zeros((window, widest, 22, size)) for name, size in sizes.items()}
    wanted |= {"mask": np.zeros((window, widest, 22), bool), "scales": np.zeros((widest, 22))}
    wanted["contacts"] = np.zeros((window, widest * (widest - 1) // 2, 22, 22))
    for row in range(rows.num_rows):
        at, person = rows["frame"][row] - start, rows["person"][row]
        if rows["variant_id"][row] == variant_id and 0 <= at < window:
            positions, unitquat = rows["body22_m"][row], rows["body22_unitquat"][row]
            is_there = np.isfinite(positions).all(axis=-1, keepdims=True)
            wanted["positions"][at, person] = np.where(is_there, positions, 0.0)
            is_turned = is_there & np.isfinite(unitquat).all(axis=-1, keepdims=True)
            wanted["rotations"][at, person] = np.where(is_turned, unitquat, 0.0)
            wanted["mask"][at, person] = is_there[:, 0]
    for row in range(poses.num_rows):
        if 0 <= (at := poses["frame"][row] - start) < window:
            wanted["source"][at, poses["person"][row]] = poses["body22_m"][row]
    row = quality["variant_id"].tolist().index(variant_id)
    wanted["scales"][:count] = quality["bone_scale"][row].reshape(count, 22)
    rest = people["body22_rest_m"] * wanted["scales"][0, 0]  # all bones have one scale here
    wanted["skeleton"] = np.concatenate([rest, np.zeros((widest - count, 22, 3))])
    pairs = sorted(combinations(range(widest), 2), key=lambda pair: pair[::-1])
    held = next(take for take in Data(store).takes("drawn") if take.name == take_id).contacts
    for frame, person, bone, weight in zip(held.frame, held.person, held.bone, held.weight, strict=True):
        if 0 <= frame - start < window and person.min() >= 0 and person[0] != person[1]:
            (a, b), order = np.sort(person), np.argsort(person)
            place = (frame - start, pairs.index((a, b)), *bone[order])
            wanted["contacts"][place] = max(wanted["contacts"][place], np.float32(weight))
    return wanted


def test_a_batch_of_ragged_people_is_what_the_tables_hold_with_masks(store: Store, windows: PairDataset) -> None:
    assert {windows[at]["positions"].shape[1] for at in range(len(windows))} == {2, 3}
    order = np.random.default_rng(0).permutation(len(windows))
    batch = windows[order]
    assert batch.keys() == {*FIELDS, "name", "start", "rate_hz"}
    assert batch["contacts"].any(axis=(1, 3, 4)).any(axis=0).tolist() == [True, False, True]
    for row in range(len(order)):
        wanted = plain_window(store, batch["name"][row], batch["start"][row], 5, 3)
        for name, values in wanted.items():
            np.testing.assert_allclose(batch[name][row], values, atol=1e-6, err_msg=name)
            assert batch[name].dtype == (bool if name == "mask" else np.float32)
    for row, item in enumerate(windows.__getitems__(order.tolist())):
        assert all(np.array_equal(item[name], batch[name][row]) for name in batch)
    with pytest.raises(IndexError, match=f"there are {len(windows)} windows"):
        windows[len(windows)]
    assert windows[-1]["start"] == windows[len(windows) - 1]["start"]


def test_windows_of_takes_are_the_takes_themselves(store: Store) -> None:
    windows = PairDataset("poses:drawn", 4, store=store)
    takes = {clip.name: clip for clip in Data(store).takes("drawn")}
    for item in map(windows.__getitem__, range(len(windows))):
        frames = slice(item["start"], item["start"] + 4)
        np.testing.assert_allclose(item["positions"], takes[item["name"]].positions_m[frames], atol=1e-6)
        np.testing.assert_array_equal(item["positions"], item["source"])
        np.testing.assert_allclose(np.linalg.norm(item["rotations"], axis=-1), 1.0, atol=1e-5)
        assert (item["scales"] == 1.0).all()
        assert item["mask"].all()


def test_a_folder_gives_the_windows_of_the_store_that_it_was_written_from(tmp_path: Path) -> None:
    takes = [replace(take, has_holes=False, verdicts=("pass",) * len(take.verdicts)) for take in TAKES]
    store, _ = drawn_store(str(tmp_path / "store"), takes)
    folder = tmp_path / "folder"
    for words in (["create", "drawn", "--study", "drawn"], ["write", "drawn@1", "--out", str(folder)]):
        assert run_command_line(["dataset", *words, "--store", str(store.root)]) == 0
    sides = json.loads((folder / "splits.json").read_bytes())["takes"]
    for table in ("variants", "poses"):
        for split in ("train", "validation", "test"):
            datasets = [
                PairDataset(f"{table}:{where}", 3, split, store=store)  # type: ignore[arg-type]
                for where in ("drawn", folder)
            ]
            stored, written = (windows[range(len(windows))] for windows in datasets)
            orders = [np.lexsort((batch["start"], batch["name"])) for batch in (stored, written)]
            assert places([stored]) != []
            assert sorted(places([stored])) == sorted(places([written]))
            assert {sides[name.partition(", ")[0]]["split"] for name in written["name"]} == {split}
            for name in FIELDS:
                np.testing.assert_allclose(written[name][orders[1]], stored[name][orders[0]], atol=1e-6, err_msg=name)
        stored, written = (
            PairDataset(f"{table}:{where}", 3, store=store, is_normalised=True).normaliser
            for where in ("drawn", folder)
        )
        for name in ("mean", "deviation"):  # six digits in the folder
            np.testing.assert_allclose(getattr(written, name), getattr(stored, name), atol=2e-6)
    with pytest.raises(InputError, match="says itself which takes stand where: by, seed and curation are for a store"):
        PairDataset(f"variants:{folder}", 3, seed=1)


def test_normalised_positions_have_mean_0_and_deviation_1_and_come_back(store: Store, windows: PairDataset) -> None:
    normalised = PairDataset("variants:drawn", 1, store=store, stride=1, is_normalised=True, seed=SEED)
    plain = PairDataset("variants:drawn", 1, store=store, stride=1, seed=SEED)[range(len(normalised))]
    batch = normalised[range(len(normalised))]
    values = np.where(batch["mask"][..., None], batch["positions"], np.nan).reshape(-1, 22, 3)
    assert np.abs(np.nanmean(values, axis=0)).max() < 1e-4
    np.testing.assert_allclose(np.nanstd(values, axis=0), 1.0, atol=1e-3)
    assert (batch["positions"][~batch["mask"]] == 0.0).all()
    assert normalised.normaliser is not None
    for name in ("positions", "source"):
        back = normalised.normaliser.undo(batch[name])
        np.testing.assert_allclose(back[batch["mask"]], plain[name][batch["mask"]], atol=1e-5)
    test = PairDataset("variants:drawn", 1, "test", store=store, is_normalised=True, seed=SEED).normaliser
    assert test is not None
    np.testing.assert_array_equal(test.mean, normalised.normaliser.mean)


@pytest.mark.usefixtures("forking")
@pytest.mark.filterwarnings("ignore:This DataLoader will create")  # more workers than this machine has cores
@pytest.mark.parametrize("is_shuffled", [True, False])
def test_ranks_and_workers_share_an_epoch_without_overlap(windows: PairDataset, is_shuffled: bool) -> None:
    from torch.utils.data import DataLoader

    every = places([windows[range(len(windows))]])
    for num_ranks in (1, 2, 3):
        streams = [
            PairStream(windows, 2, is_shuffled=is_shuffled, seed=4, rank=rank, num_ranks=num_ranks)
            for rank in range(num_ranks)
        ]
        shares = [places(stream) for stream in streams]
        assert sorted(place for share in shares for place in share) == sorted(every)
        assert [len(list(stream)) for stream in streams] == [len(stream) for stream in streams]
    whole = [places(PairStream(windows, 2, is_shuffled=is_shuffled, seed=4))]
    for count in (1, 2, 3):
        stream = PairStream(windows, 2, is_shuffled=is_shuffled, seed=4)
        whole.append(places(DataLoader(stream, batch_size=None, num_workers=count)))  # type: ignore[arg-type]
    assert all(order == whole[0] for order in whole)
    assert (whole[0] == every) is not is_shuffled
    even = [PairStream(windows, 2, rank=rank, num_ranks=3, drops_rest=True) for rank in range(3)]
    assert len({len(list(stream)) for stream in even}) == 1


def test_epochs_differ_and_each_is_always_the_same(windows: PairDataset) -> None:
    stream, copied = PairStream(windows, 3, seed=1), pickle.loads(pickle.dumps(PairStream(windows, 3, seed=1)))
    first, second = places(stream), places(stream)
    assert first != second
    assert sorted(first) == sorted(second)
    assert first == places(copied)
    copied.set_epoch(1)
    assert second == places(copied)
    assert first != places(PairStream(windows, 3, seed=2))


@pytest.mark.usefixtures("forking")
@pytest.mark.parametrize("num_workers", [0, 2])
def test_a_stream_goes_on_where_it_was_left(windows: PairDataset, num_workers: int) -> None:
    from torch.utils.data import DataLoader

    whole = PairStream(windows, 2, seed=7)
    places(whole)
    batches = [places([batch]) for batch in whole]  # the second epoch
    for count in (0, 1, 4, len(batches)):
        left = PairStream(windows, 2, seed=7)
        left.set_epoch(1)
        some = iter(left)
        assert [places([next(some)]) for _ in range(count)] == batches[:count]
        stream = PairStream(windows, 2, seed=7)
        assert left.state_dict() == {"epoch": 1, "batch": count}
        stream.load_state_dict(left.state_dict())
        rest = DataLoader(stream, batch_size=None, num_workers=num_workers)  # type: ignore[arg-type]
        assert [places([batch]) for batch in rest] == batches[count:]
    for state in ({}, {"epoch": 0, "batch": -1}, {"epoch": 0.5, "batch": 0}):
        with pytest.raises(InputError):
            whole.load_state_dict(state)  # type: ignore[arg-type]


def test_the_order_of_many_clips_is_a_permutation_any_part_of_which_is_known() -> None:
    counts = np.random.default_rng(0).integers(0, 4, 2_500)
    order = WindowOrder(counts, lambda group: np.random.default_rng([5, group]))
    whole = order.windows(0, len(order))
    assert sorted(whole) == list(range(counts.sum()))
    again = WindowOrder(counts, lambda group: np.random.default_rng([5, group]))
    for start, stop in ((0, 3), (1_400, 2_700), (len(order) - 2, len(order) + 9), (7, 7)):
        np.testing.assert_array_equal(again.windows(start, stop), whole[start:stop])
    assert len(WindowOrder(counts[:0], None).windows(0, 5)) == 0


def test_an_argument_of_windows_or_stream_that_is_not_allowed_is_named(store: Store, windows: PairDataset) -> None:
    for fields in ("positions", [], ["velocity"]):
        with pytest.raises(InputError, match=r"^fields is .*; it must be some of positions, rotations"):
            PairDataset("variants:drawn", store=store, fields=fields)  # type: ignore[arg-type]
    for name, value in (("batch_size", 0), ("seed", -1), ("rank", -1), ("num_ranks", 0), ("rank", 1)):
        with pytest.raises(InputError, match=f"^{name} is {value}; it must be"):
            PairStream(windows, **{name: value})  # type: ignore[arg-type]
    with pytest.raises(InputError, match="is no folder that `pasdedeux dataset write` finished"):
        PairDataset(f"variants:{store.root}")


def test_a_cut_file_of_the_cache_is_said(store: Store) -> None:
    windows = PairDataset("variants:drawn/take-1", 5, store=store)
    path = windows._files.folder / "positions"
    path.write_bytes(path.read_bytes()[:-1000])
    with pytest.raises(CorruptArtifact, match="positions is cut short; remove the folder, it is unpacked anew"):
        windows[range(len(windows))]


_READ = """
import resource, sys
from tasks.rows.unpacking import unpack_artifacts
from tasks.windows import PairDataset, PairStream
windows = PairDataset("variants:drawn", 30, store=sys.argv[1])
stream = PairStream(windows, 64)
next(iter(stream))
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
for _ in range(2):
    for batch in stream:
        pass
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before, windows._files.folder)
"""


def test_reading_a_big_folder_keeps_nothing_of_it(tmp_path: Path, own_cache: Path) -> None:
    drawn_store(str(tmp_path / "store"), [Drawn("waltz", 900, False, ("pass",) * 40)])
    words = [sys.executable, "-c", _READ, str(tmp_path / "store")]
    environment = {"PASDEDEUX_CACHE": str(own_cache), "PATH": "", "PYTHONPATH": str(ROOT)}
    done = subprocess.run(words, capture_output=True, text=True, check=True, env=environment)
    grown_kb, folder = done.stdout.split()
    size = sum(path.stat().st_size for path in Path(folder).iterdir())
    assert size > 40e6
    assert int(grown_kb) * 1e3 < 25e6  # a few batches of 7 MB


def test_the_notebook_trains_and_is_kept_without_outputs(
    store: Store, own_cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PASDEDEUX_CACHE", str(own_cache))
    given = f'reference, store, window, steps = "variants:drawn", {str(store.root)!r}, 4, 12'
    *_, last_step, mean_cm = filter(None, run_notebook("train.ipynb", given, tmp_path).splitlines())
    assert re.fullmatch(r"step 12: \d+\.\d\d cm", last_step)
    errors_cm = ast.literal_eval(mean_cm)
    assert errors_cm.keys() == {"network", "take as it is"}
    assert all(0.0 < value < 1000.0 for value in errors_cm.values())


@pytest.mark.slow
@pytest.mark.parametrize("label", loader.BENCHMARKS)
def test_the_benchmark_measures_the_stream_beside_other_readers(label: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("_TAKES", 3), ("_VARIANTS", 2), ("_ROWS_OF_DATASETS", 60)):
        monkeypatch.setattr(loader, name, value)
    monkeypatch.setattr("datasets.config.SLEEP_TIME_ON_THREADS_SHUTDOWN", 0.0)  # it sleeps for seconds after each pass
    result = loader.BENCHMARKS[label]()
    assert result.fast_per_s > 0.0
    assert result.plain_per_s > 0.0


def test_a_normaliser_of_chunks_is_that_of_the_whole_and_refuses_what_is_not_finite() -> None:
    rows = np.random.default_rng(0).normal(10.0, 0.1, (300, 22, 3)).astype(np.float32)
    rows[:, 4, 1] = 2.0
    normaliser = Normaliser.of(rows[start : start + 70] for start in range(0, 300, 70))
    np.testing.assert_allclose(normaliser.mean, rows.astype(np.float64).mean(axis=0), rtol=1e-6)
    wanted = rows.astype(np.float64).std(axis=0)
    np.testing.assert_allclose(normaliser.deviation, np.where(wanted > 0, wanted, 1.0), rtol=1e-4)
    values = rows.copy()
    normaliser.apply(values)
    np.testing.assert_allclose(normaliser.undo(values), rows, rtol=1e-6)
    with pytest.raises(InputError, match="must be finite"):
        Normaliser(np.full((22, 3), np.nan), np.ones((22, 3)))
    with pytest.raises(InputError, match="no positions"):
        Normaliser.of([])
