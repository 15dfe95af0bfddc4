"""Takes and trained models that commands are given: from a store, or from files."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

from typer import Argument

from flows.console.context import key_option, open_store
from flows.exports.model_weights import stored_weights
from flows.study import load_study
from pasdedeux.errors import InputError
from pasdedeux.learning.registry import Weights, read_weights
from pasdedeux.plain_text import counted
from storage_schema import ArtifactRef, Store, parse_reference, resolve
from tasks.facts import ModelFacts
from tasks.graph import load_graph
from tasks.ingest import STAGE, IngestParameters
from tasks.ingest.files import load_file
from tasks.ingest.takes.parameters import PersonOptions, TakeParameters
from tasks.stage import StageInputs

TakeArgument = Annotated[
    list[str], Argument(metavar="TAKE", help="STUDY/TAKE, a study file, or a motion file for each person.")
]
UnitOption = Annotated[list[float] | None, key_option(PersonOptions, "metres_per_unit", "--unit", metavar="M")]
RateOption = Annotated[float | None, key_option(PersonOptions, "rate_hz", "--rate", metavar="HZ")]


@contextmanager
def find_take(
    take: Sequence[str], store_root: Path, units_m: Sequence[float], rate_hz: float | None
) -> Iterator[tuple[Store, ArtifactRef]]:
    """Find the one take that a reference names, or read motion files into a store that is gone afterwards.

    Raises:
        InputError: It is not there, not one, or its files cannot be read.
    """
    if len(take) == 1 and Path(take[0]).suffix == ".toml" and Path(take[0]).is_file():
        with _read_section(_section_of_study(take[0])) as found:
            yield found
        return
    if len(take) > 1 or Path(take[0]).is_file():
        with _take_of_files(take, units_m, rate_hz) as found:
            yield found
        return
    store = open_store(store_root)
    text = take[0] if re.match(r"\w+[:@]", take[0]) else f"poses:{take[0]}"
    reference = parse_reference(text)
    refs = resolve(reference, store)
    if reference.table != "poses" or len(refs) != 1:
        raise InputError(
            f"'{take[0]}' names {counted(len(refs), 'artifact')} of {reference.table}; one take is needed: STUDY/TAKE"
        )
    yield store, refs[0]


@contextmanager
def _take_of_files(
    files: Sequence[str], units_m: Sequence[float], rate_hz: float | None
) -> Iterator[tuple[Store, ArtifactRef]]:
    """Read motion files as a study would, at their own rate, into a store that is gone afterwards."""
    if len(units_m) > len(files):
        raise InputError(f"--unit is given {counted(len(units_m), 'time')} for {counted(len(files), 'file')}")
    last = len(units_m) - 1
    units = [units_m[min(person, last)] if units_m else None for person in range(len(files))]
    take = {
        "id": re.sub(r"[^A-Za-z0-9_-]", "_", Path(files[0]).stem).lstrip("_-")[:100] or "take",
        "files": [str(Path(file).resolve()) for file in files],
        "rate_hz": rate_hz,
        "persons": [{"metres_per_unit": unit} for unit in units],
    }
    section = IngestParameters.model_validate({"takes": [take]})
    try:
        with _read_section(section) as found:
            yield found
    except InputError as error:
        said = str(error).replace("set metres_per_unit for this take", "say --unit")
        said = said.replace("set rate_hz for this take", "say --rate")
        if re.search(r"; set \w+|\[ingest\.mappings\]|persons", said):
            said += "; `pasdedeux study new take.toml --from FILE ...` writes such keys, and TAKE may be take.toml"
        raise type(error)(said) from None


def _section_of_study(path: str) -> IngestParameters:
    """Return the first take of a study's files, with all that the study says of it.

    Raises:
        InputError: It has no [[ingest.takes]], or is no study.
    """
    section = load_study(path, load_graph())[0].parameters["ingest"]
    assert isinstance(section, IngestParameters)
    if not section.takes:
        raise InputError(f"study {path} has no [[ingest.takes]]")
    return IngestParameters(takes=section.takes[:1], mappings=section.mappings, capture=section.capture)


@contextmanager
def _read_section(section: IngestParameters) -> Iterator[tuple[Store, ArtifactRef]]:
    """Read the only take of a section at the least of the rates of its files."""
    planned = STAGE.plan(StageInputs(manifests={}, seed=0), section)[0].parameters
    assert isinstance(planned, TakeParameters)
    own_hz = min(person.rate_hz for person in planned.persons)
    shard = STAGE.plan(StageInputs(manifests={}, seed=0), section.model_copy(update={"rate_hz": own_hz}))[0]
    with tempfile.TemporaryDirectory() as folder:
        store = Store(Path(folder))
        yield store, STAGE.run_shard(shard, store)


def find_model(text: str, store_root: Path) -> Weights:
    """Read a trained model from a file, or from the store: the only one of this name, or that of one split."""
    path = Path(text)
    if path.suffix == ".safetensors":
        return read_weights(load_file(path).data, path.name)
    store, (name, _, where) = open_store(store_root), text.partition("@")
    if where:
        refs = resolve(where if re.match(r"\w+[:@]", where) else f"models:{where}", store)
        manifests = [store.manifest(ref) for ref in refs]
    else:
        manifests = list(store.artifacts("training"))
    models = [manifest for manifest in manifests if "models" in manifest.tables]
    found = [manifest for manifest in models if ModelFacts.of(manifest).model == name]
    if len(found) != 1:
        named = [(ModelFacts.of(one), one.ref.key[:12]) for one in found or models]
        there = [f"{one.model}@models@{key} ({one.split})" for one, key in named]
        which = f"say which: {', '.join(there[:12])}" if there else "the store has none; the stage training makes them"
        raise InputError(f"model {text}: {len(found)} models of the store have this name; {which}")
    return stored_weights(store, found[0])


def known_take(weights: Weights, ref: ArtifactRef, take_id: str) -> tuple[str, str]:
    """Return the name under which a model is asked for a take, and in words whether it was trained on it.

    A take of the same name may be another one, so only the same content has the name that the model knows.
    """
    is_known = weights.takes.get(take_id) == ref.content_digest
    name = take_id if is_known else f"{take_id} ({ref.key[:12]})"
    return name, f"{weights.model.name} {'was' if is_known else 'was not'} trained on take {take_id}"
