"""`restart` and `complete`: what is done with draws: chains that start at one, joints that a pair lacks."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Argument, Option

from flows.console.context import (
    JsonOption,
    OversubscribeOption,
    SettingOption,
    StoreOption,
    WorkersOption,
    app,
    echo,
    graph_of,
    next_command,
    open_store,
)
from flows.console.run import build_and_report
from flows.machine import cluster_settings
from flows.outcomes import Run
from flows.planning import PlanError, Selection
from flows.records import last_sections, read_last_run
from flows.study import study_from_tree
from flows.study_files import HEAD, PUBLISH, StudyTree
from storage_schema import Store, latest_studies

if TYPE_CHECKING:
    from tasks.seeds.files import DrawSeed

_NO_OTHER_SEEDS = {"num_seeds": 0, "frames": [], "num_lifted": 0, "num_grown": 0, "num_starts": 0}


@app.command()
def restart(
    context: typer.Context,
    draw: Annotated[str, Argument(metavar="DRAW", help="One draw: draws@key#row or draws:study/partition#row.")],
    settings: SettingOption = None,
    out: Annotated[Path, Option("--out", metavar="DIR", help="Folder for the seed's file.")] = Path("restarts"),
    edited: Annotated[Path | None, Option(metavar="FILE", help="The draw's JSON file after changes: the seed.")] = None,
    store: StoreOption = Path("store"),
    workers: WorkersOption = None,
    oversubscribe: OversubscribeOption = False,
    as_json: JsonOption = False,
) -> None:
    """Start new chains from a draw.

    This is the restart of Yin et al. 2018, section 5.3.

    Inspect the draws (`pasdedeux show draws:duets/ic-seed0#17`), choose one, and run

    \b
      pasdedeux restart draws:duets/ic-seed0#17
      pasdedeux restart draws@3fa9c1#17 --set chains.num_draws=5000 --set chains.proposal=velocity

    The draw is written to a JSON file, which you can edit and name with --edited, and becomes the only seed of a new
    study with the settings of the original.  The study runs up to its chains; everything else is in the store already.
    The new draws keep the lineage: their seed names the draw, with its takes and credits.
    """
    from pasdedeux.errors import named
    from pasdedeux.formats.pair_file import read_pair_json, write_pair_json
    from tasks.seeds.files import pair_of_draw
    from tasks.sweep import merged
    from tasks.user_files import read_file

    cluster = cluster_settings(workers, oversubscribe=oversubscribe)
    opened = open_store(store)
    chosen = pair_of_draw(opened, draw)
    origin, sections = _study_of(opened, chosen)
    path = edited or out / f"draw-{chosen.ref.key[:12]}-{chosen.row}.json"
    name = f"{origin}-restart-{chosen.ref.key[:12]}-{chosen.row}"
    if edited is not None:
        data = read_file(edited)
        with named(edited.name):
            read_pair_json(data)
        name += f"-{hashlib.sha256(data).hexdigest()[:6]}"
    title = f"Restart from draws@{chosen.ref.key[:12]}#{chosen.row}"
    tree = {section: dict(values) for section, values in sections.items() if section != PUBLISH}
    tree[HEAD] = {key: value for key, value in tree[HEAD].items() if value is not None} | {"name": name, "title": title}
    tree["seeds"] |= {**_NO_OTHER_SEEDS, "files": [{"path": str(path.resolve())}]}
    sweeps = tree["chains"].pop("sweep", {})
    if chosen.density in sweeps:  # kept under the name of a sweep, which samples the first of its densities
        tree["chains"] = merged(tree["chains"], sweeps[chosen.density])
        tree["chains"]["densities"] = tree["chains"]["densities"][:1]
    else:
        tree["chains"]["densities"] = [chosen.density]
    study, graph = study_from_tree(
        StudyTree(name, tree, {(): Path.cwd()}), graph_of(context), here=Path.cwd(), settings=settings or ()
    )
    if edited is None:
        out.mkdir(parents=True, exist_ok=True)
        path.write_text(write_pair_json(chosen.pair), encoding="utf-8")
    if not as_json:
        echo(f"the draw is the seed in {path}; its study is {name}")
    build_and_report(Run(study, graph, opened, Selection(until="chains")), cluster, as_json=as_json)
    if not as_json:
        echo(f"new draws: {next_command('show', f'draws:{name}', store=store)}")
        echo(f"how the chains went: {next_command('show', f'chain_info:{name}', store=store)}")


def _study_of(store: Store, chosen: DrawSeed) -> tuple[str, dict[str, Any]]:
    """Return the study that a draw is from, with its settings as they were."""
    for study in latest_studies(store):
        last = read_last_run(store, study)
        if last and chosen.ref in last.refs("chains") and (sections := last_sections(store, last)):
            return study, sections
    draw = f"draws@{chosen.ref.key[:12]}#{chosen.row}"
    command = next_command("export", draw, "--format", "json", "--out", "seeds", store=Path(str(store)))
    raise PlanError(
        f"draws@{chosen.ref.key[:12]} belongs to no study that is on record in the store {store}: "
        f"its settings are not known.  Export it ({command}) and name the file in a study under seeds.files"
    )


@app.command()
def complete(
    file: Annotated[Path, Argument(metavar="FILE", help="JSON file of a pair.")],
    draws: Annotated[str, Option("--draws", metavar="REF", help="Draws or seeds: draws:study, seeds:study.")],
    num_nearest: Annotated[int, Option("--nearest", min=1, help="Number of nearest draws used.")] = 100,
    out: Annotated[Path | None, Option("--out", metavar="FILE", help="The completed pair.")] = None,
    store: StoreOption = Path("store"),
) -> None:
    """Fill in the unknown joints of a 3D pair, such as one from a depth camera.

    This is the pose completion of Yin et al. 2018, Fig. 12.

    \b
      pasdedeux complete pair.json --draws draws:duets
      pasdedeux complete pair.json --draws seeds:mine --out whole.json

    FILE is a pair as written by `pasdedeux export seeds:... --format json`.  Unknown joints are absent or null; one
    person may lack all joints.  The missing joints come from the draws that are nearest over the known joints; unknown
    bone lengths come from the draws, too.  The spread of these draws is printed for each person, and the completed pair
    is written to --out (default: FILE_completed.json).
    """
    import numpy as np

    from pasdedeux.completion.occlusion import complete_pair
    from pasdedeux.errors import InputError, named
    from pasdedeux.formats.pair_file import PairFile, PairSource, read_pair_json, write_pair_json
    from storage_schema import parse_reference, resolve, source_credits
    from tasks.draw_sets import read_all_draws
    from tasks.stage import merge_takes
    from tasks.user_files import read_file

    data, opened = read_file(file), open_store(store)
    reference = parse_reference(draws)
    if reference.table not in ("draws", "seeds"):
        raise InputError(f"--draws: '{draws}' names no draws; draws:study, draws@key or seeds:study do")
    refs = resolve(reference, opened)
    with named(file.name):
        pair = read_pair_json(data, is_partial=True)
        is_known = np.asarray(np.isfinite(pair.pair_m).all(axis=-1))
        if is_known.all():
            raise InputError("no joint is missing; one that is not known is absent, or null")
        known = read_all_draws(opened, refs)
        found = complete_pair(pair.pair_m, known.pairs_m, num_nearest=num_nearest)
    manifests = [opened.manifest(ref) for ref in refs]
    inherited = [PairSource(one.name, one.licence, one.credit) for one in source_credits(opened, *refs)]
    whole = PairFile(
        pair_m=found.fitted_m,
        made_from=f"{pair.made_from or file.name}, completed by {draws}",
        takes=tuple(sorted({*pair.takes, *merge_takes(*manifests)})),
        sources=tuple(dict.fromkeys((*pair.sources, *inherited))),
    )
    target = out or file.with_name(f"{file.stem}_completed.json")
    target.write_text(write_pair_json(whole), encoding="utf-8")
    spread = np.linalg.norm(found.neighbours.pairs_m - np.median(found.neighbours.pairs_m, axis=0), axis=-1)
    for name, own, apart in zip("AB", is_known, np.moveaxis(spread, 1, 0), strict=True):
        if not own.all():
            far_cm = 100.0 * float(np.median(apart[:, ~own]))
            echo(f"person {name}: {int((~own).sum())} joints completed, {far_cm:.1f} cm uncertain (median)")
    near_m = found.neighbours.distance_m
    echo(f"{len(near_m)} of {len(known.pairs_m)} draws within {100 * near_m.max():.1f} cm (D_I)")
    echo(f"written: {target}")
