"""The work of `retarget`: a take and bodies are found, scales are fitted, the take is solved and written."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from string import ascii_uppercase

import numpy as np

from flows.console.context import echo, open_store, say
from flows.console.display import format_table
from flows.exports import RestPose, Units, write_credits
from flows.exports.export_format import write_text
from flows.exports.model_weights import stored_weights
from flows.exports.own_skeletons import Person, RigFiles, people_of_take
from flows.study import load_study
from pasdedeux.augmentation import Augmenter
from pasdedeux.augmentation.source import complete_scales
from pasdedeux.augmentation.variations import Variation
from pasdedeux.errors import InputError
from pasdedeux.evaluation.pictures import PLAYER, Picture
from pasdedeux.evaluation.verdicts import verdict_words
from pasdedeux.formats.asf_amc import read_asf
from pasdedeux.formats.file_format import FileStart
from pasdedeux.formats.own_skeleton import OwnSkeleton, body_map
from pasdedeux.formats.registry import MOTION_FORMATS
from pasdedeux.formats.source_motion import SourceMotion
from pasdedeux.formats.target_body import BodyFit, TargetBody, body_of_skeleton, fit_body, read_body
from pasdedeux.learning.model import VariantRequest
from pasdedeux.learning.registry import Weights, read_weights
from pasdedeux.plain_text import counted
from pasdedeux.skeletons import BODY22
from pasdedeux.verdict import Level
from storage_schema import ArtifactRef, Store, parse_reference, resolve, source_credits
from tasks.data import LOOK, player_page
from tasks.evaluation.augmentation import variant_player
from tasks.facts import ModelFacts, TakeFacts
from tasks.graph import load_graph
from tasks.ingest import STAGE, IngestParameters
from tasks.ingest.files import load_file
from tasks.ingest.takes.parameters import PersonOptions, TakeParameters
from tasks.ingest.takes.resolution import resolve_file
from tasks.stage import StageInputs, verdict_of
from tasks.takes import read_take

_MISFIT_M = 0.05
"""A body that is missed by more than this, in any distance, is warned of."""
KEPT = "source"
"""Stands for a body that stays as captured."""


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
            f"'{take[0]}' names {len(refs)} artifacts of {reference.table}; one take is needed: STUDY/TAKE"
        )
    yield store, refs[0]


@contextmanager
def _take_of_files(
    files: Sequence[str], units_m: Sequence[float], rate_hz: float | None
) -> Iterator[tuple[Store, ArtifactRef]]:
    """Read motion files as a study would, at their own rate, into a store that is gone afterwards."""
    if len(files) > len(ascii_uppercase):
        raise InputError(f"{len(files)} motion files are given, one a person; a take has at most 26 people")
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


def read_targets(bodies: Sequence[str], units_m: Sequence[float]) -> list[TargetBody | None]:
    """Read a body for each person, None for `source`; `units_m` are metres per unit of those that are BVH files.

    Raises:
        InputError: A body cannot be read.
    """
    left = iter(units_m)
    return [None if body == KEPT else _read_target(Path(body), left) for body in bodies]


def _read_target(path: Path, units_m: Iterator[float]) -> TargetBody:
    """Read a body from whatever kind of file it is."""
    loaded = load_file(path)
    data, start = loaded.data, FileStart(loaded.data)
    try:
        if MOTION_FORMATS["bvh"].recognises(start):
            rest = MOTION_FORMATS["bvh"].read_head(data).rest
        elif MOTION_FORMATS["asf_amc"].is_companion(start):
            asf = read_asf(data)
            rest = SourceMotion.at_rest(asf.skeleton, asf.rest_offsets, metres_per_unit=asf.metres_per_unit)
        elif MOTION_FORMATS["asf_amc"].recognises(start):
            raise InputError("an AMC file holds no body; give its ASF file")
        else:
            return read_body(path.name, data)
        unit_m = None if rest.metres_per_unit else next(units_m, None)
        taken = resolve_file(loaded.file, rest, PersonOptions(metres_per_unit=unit_m))
        layout = taken.required_layout()
        motion = rest.to_motion(metres_per_unit=taken.required_unit_m(), rate_hz=1.0)
        body = body_map(layout, motion.skeleton, motion.rest_offsets_m)
        return body_of_skeleton(path.name, OwnSkeleton(motion, body), layout.name)
    except InputError as error:
        said = str(error).replace("; name a layout, or write one under [ingest.mappings]", "")
        said = said.replace("set metres_per_unit for this take", "say --body-unit")
        raise type(error)(said if said.startswith(path.name) else f"{path.name}: {said}") from None


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


def retarget_take(
    store: Store,
    ref: ArtifactRef,
    targets: Sequence[TargetBody | None],
    out: Path,
    *,
    rest_pose: RestPose = "source",
    units: Units = "cm",
    weights: Weights | None = None,
) -> None:
    """Solve a take for bodies, or ask a trained model, write its files, and say what came of it.

    Raises:
        InputError: There are more bodies than people, a body cannot be anybody's, or the model is of pairs and the take
            is none.
    """
    take = TakeFacts.of(store.manifest(ref))
    take_id, count = take.take_id, take.num_persons
    if len(targets) > count:
        who = "one person" if count == 1 else f"{count} people"
        raise InputError(f"{len(targets)} bodies are given, but take {take_id} has {who}: --to once for each, A first")
    source = read_take(store, ref).source
    people = people_of_take(store, ref)
    bone_scale = np.ones((count, BODY22.num_joints))
    rows = []
    contradictions: list[tuple[Person, float]] = []
    for index, (person, target) in enumerate(zip(people, targets, strict=False)):
        if target is None:
            continue
        who = f"person {person.letter} of take {take_id}"
        fit = fit_body(target, person.own, source.lengths_m[index], layout=person.layout, who=who)
        bone_scale[index] = fit.bone_scale
        rows.append(_said(person, target, fit))
        worst_m = max(map(abs, fit.misfit_m.values()))
        if worst_m > _MISFIT_M:
            contradictions.append((person, worst_m))
    solver = Augmenter(source, user_contacts=take.contacts)
    if weights is None:
        variant = solver.solve([Variation("retarget", bone_scale)])[0]
        positions_m, bone_scale, verdict = variant.positions_m, variant.bone_scale, variant.verdict
    else:
        bone_scale = complete_scales(source, bone_scale[None])[0]
        # A take of the same name may be another one: what a model learned of a take holds for that take alone.
        is_known = weights.takes.get(take_id) == ref.content_digest
        name = take_id if is_known else f"{take_id} ({ref.key[:12]})"
        positions_m = weights.model.predict(VariantRequest(name, source, bone_scale, contacts=take.contacts))
        verdict = solver.assess(Variation("retarget", bone_scale), positions_m).verdict
        echo(f"{weights.model.name} {'was' if is_known else 'was not'} trained on take {take_id}", err=True)
    out.mkdir(parents=True, exist_ok=True)
    files = RigFiles(out, rest_pose=rest_pose, units=units)
    files.write_variant("retarget", people, positions_m, bone_scale)
    credits_path = write_credits(source_credits(store, ref), [ref], f"take {take_id}", out)
    player = variant_player(source, {"source": source.positions_m, "retarget": np.asarray(positions_m)})
    shown = Picture(f"retarget{PLAYER}", f"take {take_id} and its retarget; its contacts are green", player)
    page = write_text(out / LOOK, player_page(f"Take {take_id}", [shown]))
    say(map(str, (*files.close(), credits_path, page)))
    if rows:
        header = ("person", "body", "size", "bones", "misfit mean", "greatest", "between")
        say(format_table(header, rows, text_columns=(0, 1, 3, 6)))
    for person, worst_m in contradictions:
        echo(
            f"warning: the body for person {person.letter} is missed by {1e3 * worst_m:.0f} mm: "
            "its distances contradict each other, or are not those of one person",
            err=True,
        )
    captured = verdict_of(store.manifest(ref))
    if captured is not None and captured.level is not Level.PASS:
        echo(f"take {take_id}: {verdict_words(captured)}", err=True)
    echo(verdict_words(verdict))


def _said(person: Person, target: TargetBody, fit: BodyFit) -> tuple[str, ...]:
    """Describe a fitted body: size, scales of bones, and misfit to the target."""
    misfit_m = {ends: abs(value) for ends, value in fit.misfit_m.items()}
    worst = max(misfit_m, key=misfit_m.__getitem__)
    return (
        person.letter,
        target.name,
        f"{np.median(fit.bone_scale[1:]):.3f}",
        f"{fit.bone_scale[1:].min():.2f}-{fit.bone_scale[1:].max():.2f}"
        + (f", {fit.num_guessed} guessed" if fit.num_guessed else ""),
        f"{1e3 * np.mean(list(misfit_m.values())):.1f} mm",
        f"{1e3 * misfit_m[worst]:.1f} mm",
        " and ".join(BODY22.joint_names[joint] for joint in worst),
    )
