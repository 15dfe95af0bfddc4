"""Seeds as files: those named by a study, those exported from the store, and draws that become seeds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

from pasdedeux.errors import InputError, named
from pasdedeux.formats.pair_file import PairFile, PairSource, pair_from_bvh, read_pair_json
from pasdedeux.sampling.parameters import PairChart
from pasdedeux.sampling.prior import PriorSettings
from storage_schema import (
    ArtifactRef,
    Manifest,
    SourceCredit,
    Store,
    parse_reference,
    source_credits,
)
from storage_schema.ancestry import inputs_with
from storage_schema.references import find_rows
from tasks.ingest.files import load_file, read_again
from tasks.ingest.takes.resolution import NOT_STATED
from tasks.stage import Parameters, Shard, SourceFile
from tasks.stage.facts import Facts


class SeedFile(Parameters):
    """A file, or two of BVH, that becomes a seed."""

    path: Path = Field(
        description="JSON file of a pair as `pasdedeux export seeds:... --format json` writes it, or BVH"
    )
    other: Path | None = Field(None, description="BVH of person B, when `path` is the BVH of person A")
    frame: int = Field(0, ge=0, description="Frame of the BVH files")
    metres_per_unit: float = Field(0.01, gt=0, description="Length of the unit of the BVH files, metres")
    takes: tuple[str, ...] = Field((), description="Takes it shows or was made from, beside those that the file names")


class FileSeed(PriorSettings, Parameters):
    """Parameters of a seed in a file, with which its shard reads it again."""

    seed_index: int
    file_format: Literal["bvh", "json"]
    frame: int
    metres_per_unit: float
    takes: tuple[str, ...]


@dataclass(frozen=True)
class LoadedSeed:
    """A seed read from files, with the files and parameters that its shard needs."""

    pair: PairFile
    files: tuple[SourceFile, ...]
    parameters: FileSeed


def load_seed(file: SeedFile, *, seed_index: int = 0) -> LoadedSeed:
    """Read and check the files of a seed, which gets this index.

    Raises:
        InputError: With the file's name in front: not there, mangled, or no pair.
    """
    paths = [file.path] if file.other is None else [file.path, file.other]
    loaded = [load_file(path) for path in paths]
    is_bvh = loaded[0].data.lstrip()[:9].upper() == b"HIERARCHY"
    name = file.path.name
    if is_bvh and file.other is None:
        raise InputError(f"seeds.files: {name} is the BVH of one person; `other` must name that of person B")
    if not is_bvh and file.other is not None:
        raise InputError(f"seeds.files: {name} is no BVH, so there can be no `other` file beside it")
    parameters = file.part(FileSeed, seed_index=seed_index, file_format="bvh" if is_bvh else "json")
    with named(f"seeds.files: {' and '.join(path.name for path in paths)}"):
        pair = _parsed(parameters, [source.data for source in loaded])
    return LoadedSeed(pair, tuple(source.file for source in loaded), parameters)


def read_seed(shard: Shard) -> PairFile:
    """Read the seed of a shard from the files and parameters that `load_seed` gave; all of its takes are named.

    Raises:
        InputError: A file changed since.
    """
    return _parsed(shard.options(FileSeed), [read_again(file) for file in shard.files])


def _parsed(parameters: FileSeed, data: Sequence[bytes]) -> PairFile:
    if parameters.file_format == "bvh":
        pair = pair_from_bvh(*data, frame=parameters.frame, metres_per_unit=parameters.metres_per_unit)
    else:
        pair = read_pair_json(data[0])
    takes = tuple(sorted({*pair.takes, *parameters.takes}))
    return PairFile(pair.pair_m, pair.made_from, takes, pair.sources)


def credits_of(pair: PairFile) -> list[SourceCredit]:
    """Return the licences and credits of a seed from a file; one that states none is named as such."""
    if not pair.sources:
        return [SourceCredit(name="seed files given in the study", licence=NOT_STATED, credit=NOT_STATED)]
    return [SourceCredit(source.name, source.licence, source.credit) for source in pair.sources]


@dataclass(frozen=True)
class DrawSeed:
    """A stored draw as a pair, with its identity."""

    pair: PairFile
    ref: ArtifactRef
    row: int
    density: str


def pair_of_draw(store: Store, text: str) -> DrawSeed:
    """Return a stored draw, in float64 as the chain had it, with its lineage.

    Args:
        store: Store that holds it.
        text: Reference to one row of `draws`: `draws@key#row`, or `draws:study/partition#row`.

    Raises:
        UnknownReference: The reference names no draw.
        InputError: It names more than one.
    """
    reference = parse_reference(text)
    if reference.table != "draws" or reference.row is None:
        raise InputError(f"'{text}' is not a draw; a draw is draws@key#row or draws:study/partition#row")
    ((ref, rows),) = find_rows(reference, store)
    manifest, row = store.manifest(ref), rows.start
    draw = store.read(ref, "draws", rows=rows)
    seed_index, density = int(draw["seed_index"][0]), str(draw["density"][0])
    (seeds_ref,) = inputs_with(store, ref, "seeds")
    seeds = store.read(seeds_ref, "seeds", columns=["seed_index", "pair17_m"])
    seed_row = int(np.flatnonzero(np.asarray(seeds["seed_index"]) == seed_index)[0])
    chart = PairChart(np.array(seeds["pair17_m"][seed_row], dtype=np.float64))
    positions = chart.positions(np.array(draw["parameters"][0], dtype=np.float64))
    return DrawSeed(_pair_file(store, manifest, positions, f"draws@{ref.key}#{row}"), ref, row, density)


def _pair_file(store: Store, manifest: Manifest, pair_m: np.ndarray, made_from: str) -> PairFile:
    """Return a pair with the takes and the credits of the artifact that it is in."""
    return PairFile(
        pair_m=pair_m,
        made_from=made_from,
        takes=Facts.of(manifest).takes,
        sources=tuple(
            PairSource(credit.name, credit.licence, credit.credit) for credit in source_credits(store, manifest.ref)
        ),
    )


def pair_in_store(store: Store, table: str, ref: ArtifactRef, row: int) -> PairFile:
    """Return the pair in a row of a table with pairs, with its lineage; a draw in float64 as the chain had it."""
    if table == "draws":
        return pair_of_draw(store, f"draws@{ref.key}#{row}").pair
    pair_m = store.read(ref, table, columns=["pair17_m"], rows=slice(row, row + 1))["pair17_m"][0]
    return _pair_file(store, store.manifest(ref), np.array(pair_m, dtype=np.float64), f"{table}@{ref.key}#{row}")


def pairs_of_seeds(store: Store, text: str) -> list[tuple[int, PairFile]]:
    """Return the seeds that a reference names, each with its index, as `export` writes them.

    Raises:
        UnknownReference: The reference names nothing.
    """
    pairs = []
    for ref, rows in find_rows(parse_reference(text), store):
        manifest, table = store.manifest(ref), store.read(ref, "seeds", columns=["seed_index", "pair17_m"], rows=rows)
        for row, (seed_index, pair_m) in enumerate(
            zip(table["seed_index"], table["pair17_m"], strict=True), rows.start
        ):
            pair = np.array(pair_m, dtype=np.float64)
            pairs.append((int(seed_index), _pair_file(store, manifest, pair, f"seeds@{ref.key}#{row}")))
    return pairs
