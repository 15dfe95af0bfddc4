"""`retarget`: moves a take of a store or of motion files to other bodies."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import numpy as np
from typer import Option

from flows.console import options
from flows.console.context import app, busy, echo, say
from flows.console.display import format_table
from flows.console.inputs import RateOption, TakeArgument, UnitOption, find_model, find_take, known_take
from flows.exports.credits import write_credits
from flows.exports.export_format import RestPose, Units, write_text
from flows.exports.own_skeletons import RigFiles, TakePerson, people_of_take
from pasdedeux.augmentation import Augmenter
from pasdedeux.augmentation.source import complete_scales
from pasdedeux.augmentation.variations import Variation
from pasdedeux.errors import InputError
from pasdedeux.evaluation.pictures import PLAYER, Picture
from pasdedeux.evaluation.verdicts import verdict_words
from pasdedeux.formats.asf_amc import read_asf
from pasdedeux.formats.file_format import FileStart
from pasdedeux.formats.registry import MOTION_FORMATS
from pasdedeux.formats.rigs.own_skeleton import OwnSkeleton, body_map
from pasdedeux.formats.rigs.target_body import BodyFit, TargetBody, body_of_skeleton, fit_body, read_body
from pasdedeux.formats.source_motion import SourceMotion
from pasdedeux.learning.model import VariantRequest
from pasdedeux.learning.registry import Weights
from pasdedeux.plain_text import counted
from pasdedeux.skeletons import BODY22
from pasdedeux.verdict import Level
from storage_schema import ArtifactRef, Store, source_credits
from tasks.data import LOOK, player_page
from tasks.evaluation.augmentation import variant_player
from tasks.ingest.files import load_file
from tasks.ingest.takes.parameters import PersonOptions
from tasks.ingest.takes.resolution import resolve_file
from tasks.rows.takes import read_take
from tasks.stage.facts import TakeFacts
from tasks.stage.judgements import verdict_of

_MISFIT_M = 0.05
"""A larger misfit in any distance of a body is a warning."""
KEPT = "source"
"""Names the captured body, which stays."""


@app.command()
def retarget(
    take: TakeArgument,
    to: Annotated[list[str], Option("--to", metavar="BODY", help="Body of person A, then of B, ...")],
    out: options.OutFolder,
    store: Annotated[Path, Option(metavar="DIR", help="Store of TAKE and NAME.")] = Path("store"),
    unit: UnitOption = None,
    body_unit: Annotated[
        list[float] | None, Option("--body-unit", min=1e-6, metavar="M", help="Metres per unit of --to.")
    ] = None,
    rate: RateOption = None,
    model: Annotated[str | None, Option(metavar="NAME", help="Trained model: NAME, NAME@STUDY/SPLIT, file.")] = None,
    rest_pose: Annotated[RestPose, Option(help="That of the source, or a standing T-pose.")] = "source",
    units: Annotated[Units, Option(help="Lengths of BVH files; `source`: as in each source's file.")] = "cm",
) -> None:
    """Retarget a take to other bodies, keep its contacts, and write it on its own skeletons.

    TAKE is STUDY/TAKE of a store, a reference to poses, or motion files (BVH, AMC with its ASF, positions), one per
    person, person A first.  Motion files need no study.  The first --to is for person A, the next for B, and so on;
    `source` keeps a person as captured.  A study file (`study new` writes one) adds layouts, mappings and axes that
    the files of its first take lack. A body is a BVH or ASF file of another person, a table of joint distances in
    metres (CSV with the columns from, to, distance_m), or joint positions with the names of body22 or SMPL (npz,
    JSON).

    \b
      pasdedeux retarget duets/waltz --to tall.bvh --out waltz_tall
      pasdedeux retarget a.bvh b.bvh --to source --to 02.asf --out b_as_02

    With --model, a trained model replaces the solver: NAME, NAME@STUDY/SPLIT if the store has several models of that
    name, or a .safetensors file written by `export`.

    \b
      pasdedeux retarget a.bvh b.bvh --to 02.asf --model ridge_adapted --out new

    It writes a BVH and an npz file per person, as `export` does, with UNITS.txt and CREDITS.txt.
    """
    weights = None if model is None else find_model(model, store)
    units_m = iter(body_unit or ())
    targets = [None if body == KEPT else _read_target(Path(body), units_m) for body in to]
    with ExitStack() as held:
        with busy("reading the take"):
            opened, ref = held.enter_context(find_take(take, store, unit or (), rate))
        _retarget_take(opened, ref, targets, out, rest_pose=rest_pose, units=units, weights=weights)


def _read_target(path: Path, units_m: Iterator[float]) -> TargetBody:
    """Read a body from a file of any kind; `units_m` are metres per unit of BVH files, each used once."""
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


def _retarget_take(
    store: Store,
    ref: ArtifactRef,
    targets: Sequence[TargetBody | None],
    out: Path,
    *,
    rest_pose: RestPose,
    units: Units,
    weights: Weights | None,
) -> None:
    """Retarget a take by the solver or a trained model, write its files, and report the result.

    Raises:
        InputError: There are more bodies than people, a body is impossible, or a model of pairs gets a take of others.
    """
    take = TakeFacts.of(store.manifest(ref))
    take_id, count = take.take_id, take.num_persons
    if len(targets) > count:
        who = counted(count, "person")
        raise InputError(f"{len(targets)} bodies are given, but take {take_id} has {who}: --to once for each, A first")
    source = read_take(store, ref).source
    people = people_of_take(store, ref)
    bone_scale = np.ones((count, BODY22.num_joints))
    rows = []
    contradictions: list[tuple[TakePerson, float]] = []
    for index, (person, target) in enumerate(zip(people, targets, strict=False)):
        if target is None:
            continue
        who = f"person {person.letter} of take {take_id}"
        with busy(f"fitting the body of {who}"):
            fit = fit_body(target, person.own, source.lengths_m[index], layout=person.layout, who=who)
        bone_scale[index] = fit.bone_scale
        rows.append(_said(person, target, fit))
        worst_m = max(map(abs, fit.misfit_m.values()))
        if worst_m > _MISFIT_M:
            contradictions.append((person, worst_m))
    with busy("finding what is in contact"):
        solver = Augmenter(source, user_contacts=take.contacts)
    if weights is None:
        with busy(f"solving {counted(len(source.positions_m), 'frame')} for these bodies"):
            variant = solver.solve([Variation("retarget", bone_scale)])[0]
        positions_m, bone_scale, verdict = variant.positions_m, variant.bone_scale, variant.verdict
    else:
        bone_scale = complete_scales(source, bone_scale[None])[0]
        name, whether_known = known_take(weights, ref, take_id)
        with busy("asking the model"):
            positions_m = weights.model.predict(VariantRequest(name, source, bone_scale, contacts=take.contacts))
        verdict = solver.assess(Variation("retarget", bone_scale), positions_m).verdict
        echo(whether_known, err=True)
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


def _said(person: TakePerson, target: TargetBody, fit: BodyFit) -> tuple[str, ...]:
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
