"""Inputs of commands, from a store or files: takes, trained models, 2D poses, film, statures, projections."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Annotated, TypeVar

from pydantic import ValidationError
from typer import Argument

from flows.console.context import echo, key_option, open_store
from flows.exports.model_weights import stored_weights
from flows.study import load_study
from flows.study_files import toml_value
from pasdedeux.errors import InputError
from pasdedeux.learning.registry import Weights, read_weights
from pasdedeux.plain_text import counted
from pasdedeux.reconstruction.sequence import SearchedDatabase
from pasdedeux.settings import first_problem
from storage_schema import ArtifactRef, Store, latest_studies, parse_reference, read_latest, resolve
from tasks.files.user_files import exported_unit_m
from tasks.graph import load_graph
from tasks.ingest import STAGE, IngestParameters
from tasks.ingest.files import load_file
from tasks.ingest.poses2d.parameters import SourceOptions
from tasks.ingest.takes.parameters import PersonOptions, TakeParameters
from tasks.projections import read_pairs, read_searched
from tasks.stage import StageInputs
from tasks.stage.facts import ModelFacts

Source = TypeVar("Source", bound=SourceOptions)
_HOW_TO_GET_ONE = (
    "`pasdedeux fetch database` makes a large database of pairs and everyday motion; `pasdedeux run duets "
    "--until projections` makes a small one of built-in motion in two minutes; a study of takes like "
    "yours makes the best one: name it with --database projections:STUDY"
)
_FEW_POSES = 2000
"""40 s of two people. The built-in duets have 1,440 poses, the database of Yiannakides et al. (2019) 7,200."""

TakeArgument = Annotated[
    list[str], Argument(metavar="TAKE", help="STUDY/TAKE, a study file, or a motion file for each person.")
]
UnitOption = Annotated[list[float] | None, key_option(PersonOptions, "metres_per_unit", "--unit", metavar="M")]
RateOption = Annotated[float | None, key_option(PersonOptions, "rate_hz", "--rate", metavar="HZ")]


@contextmanager
def find_take(
    take: Sequence[str], store_root: Path, units_m: Sequence[float], rate_hz: float | None
) -> Iterator[tuple[Store, ArtifactRef]]:
    """Find the take that a reference names, or read motion files into a temporary store.

    Raises:
        InputError: The take is missing or ambiguous, or its files cannot be read.
    """
    if len(take) == 1 and Path(take[0]).suffix == ".toml" and Path(take[0]).is_file():
        with _read_section(_section_of_study(take[0])) as take_files:
            yield take_files
        return
    if len(take) > 1 or Path(take[0]).is_file():
        with _take_of_files(take, units_m, rate_hz) as take_files:
            yield take_files
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
    """Read motion files as a study would, at their own rate, into a temporary store."""
    if len(units_m) > len(files):
        raise InputError(f"--unit is given {counted(len(units_m), 'time')} for {counted(len(files), 'file')}")
    last = len(units_m) - 1
    units = [units_m[min(at, last)] if units_m else exported_unit_m(Path(file)) for at, file in enumerate(files)]
    take = {
        "id": re.sub(r"[^A-Za-z0-9_-]", "_", Path(files[0]).stem).lstrip("_-")[:100] or "take",
        "files": [str(Path(file).resolve()) for file in files],
        "rate_hz": rate_hz,
        "persons": [{"metres_per_unit": unit} for unit in units],
    }
    section = IngestParameters.model_validate({"takes": [take]})
    try:
        with _read_section(section) as take_files:
            yield take_files
    except InputError as error:
        said = in_options(str(error))
        if re.search(r"; set \w+|\[ingest\.mappings\]|persons", said):
            said += "; `pasdedeux study new take.toml --from FILE ...` writes such keys; then give take.toml as TAKE"
        raise type(error)(said) from None


def in_options(said: str) -> str:
    """Replace keys of a study in a message by the options of a command."""
    for key, option in (("metres_per_unit", "--unit"), ("rate_hz", "--rate")):
        said = said.replace(f"set {key} for this take", f"say {option}").replace(f"set {key}", f"say {option}")
    return said


def _section_of_study(path: str) -> IngestParameters:
    """Return the first take of a study, with its mappings and its limits for captures.

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
    """Read the only take of a section, at the lowest rate of its files."""
    planned = STAGE.plan(StageInputs(manifests={}, seed=0), section)[0].parameters
    assert isinstance(planned, TakeParameters)
    own_hz = min(person.rate_hz for person in planned.persons)
    shard = STAGE.plan(StageInputs(manifests={}, seed=0), section.model_copy(update={"rate_hz": own_hz}))[0]
    with tempfile.TemporaryDirectory() as folder:
        store = Store(Path(folder))
        yield store, STAGE.run_shard(shard, store)


def find_model(text: str, store_root: Path) -> Weights:
    """Read a trained model from a file, or the one of this name (and split) from the store."""
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
    candidates = [manifest for manifest in models if ModelFacts.of(manifest).model == name]
    if len(candidates) != 1:
        named = [(ModelFacts.of(manifest), manifest.ref.key[:12]) for manifest in candidates or models]
        there = [f"{facts.model}@models@{key} ({facts.split})" for facts, key in named]
        which = (
            f"say which: {', '.join(there[:12])}" if there else "the store has none; the stage `training` makes models"
        )
        raise InputError(f"model {text}: {len(candidates)} models of the store have this name; {which}")
    return stored_weights(store, candidates[0])


def known_take(weights: Weights, ref: ArtifactRef, take_id: str) -> tuple[str, str]:
    """Return the name of a take for a model, and a sentence on whether the model was trained on it.

    Another take may have the same name, so only a take with the same content keeps the name that the model knows.
    """
    is_known = weights.takes.get(take_id) == ref.content_digest
    name = take_id if is_known else f"{take_id} ({ref.key[:12]})"
    return name, f"{weights.model.name} {'was' if is_known else 'was not'} trained on take {take_id}"


def find_source(model: type[Source], path: Path, settings: Sequence[str], **given: object) -> Source:
    """Return 2D poses or film as a study would state them, from a path, KEY=VALUE and options of a command.

    Raises:
        InputError: A key is unknown, its value is not allowed, or a film lacks one of keys, detections and detect.
    """
    name = re.sub(r"[^A-Za-z0-9_.-]", "_", path.resolve().stem).lstrip("_.-")[:100]
    stated = {key: toml_value(text) for key, _, text in (setting.partition("=") for setting in settings)}
    try:
        return model.model_validate({"id": name or "video", "path": path, **given, **stated})
    except ValidationError as error:
        problem = first_problem(error)
        raise InputError(problem if problem.startswith("one of keys") else f"--set {problem}") from None


def read_statures(texts: Sequence[str], person_ids: Iterable[int]) -> dict[int, float]:
    """Return statures by person from options: PERSON=METRES, or METRES for everybody else."""
    statures: dict[int, float] = {}
    for text in sorted(texts, key=lambda text: "=" in text):
        match = re.fullmatch(r"(?:(\d{1,9})=)?(\d(?:\.\d+)?)", text)
        metres = float(match[2]) if match else 0.0
        if match is None or not 0.5 <= metres <= 2.5:
            raise InputError(
                f"stature '{text}' is neither METRES nor PERSON=METRES; allowed: 0.5 to 2.5 m, such as 1.72"
            )
        statures |= dict.fromkeys([int(match[1])] if match[1] else person_ids, metres)
    return statures


def find_database(text: str | None, store_folder: Path, *, with_pairs: bool) -> SearchedDatabase:
    """Return the projections that a reference names, or the only ones of a store; warn if they are few."""
    store, refs = _find_projections(text, store_folder)
    searched = read_searched(store, refs)
    if words := _small_database_words(searched.poses.num_rows, len(set(searched.take_ids))):
        echo(words, err=True)
    return replace(searched, pairs_m=read_pairs(store, refs)) if with_pairs else searched


def _find_projections(text: str | None, store_folder: Path) -> tuple[Store, list[ArtifactRef]]:
    """Return a store and its projections: those that a reference names, or those of the only study that has some."""
    store = open_store(store_folder)
    if text is not None:
        refs = resolve(text, store)
        if not all(_is_part(store, ref) for ref in refs):
            raise InputError(f"'{text}' does not name projections; a reference to them starts with 'projections:'")
        return store, refs
    parts = {}
    for study in latest_studies(store):
        last = read_latest(store, study)
        parts[study] = [ref for ref in last.refs("projections") if _is_part(store, ref)] if last else []
    studies = [study for study in parts if parts[study]]
    if len(studies) != 1:
        names = ", ".join(f"projections:{study}" for study in studies)
        which = f"say which with --database, one of: {names}" if studies else _HOW_TO_GET_ONE
        has = (
            f"projections of {len(studies)} studies"
            if studies
            else "no projections, which `reconstruct` needs as its database"
        )
        raise InputError(f"store {store} has {has}; {which}")
    return store, parts[studies[0]]


def _is_part(store: Store, ref: ArtifactRef) -> bool:
    return "projections" in store.manifest(ref).tables


def _small_database_words(num_poses: int, num_takes: int) -> str:
    """Return a warning for a database that is too small for other motion than its own; empty for a larger one."""
    if num_poses >= _FEW_POSES:
        return ""
    return (
        f"the database has only {num_poses} poses of {counted(num_takes, 'take')}: enough for similar "
        "motion, not for other motion; `pasdedeux fetch database` downloads 182 takes of CMU for "
        "--database projections:everyday"
    )
