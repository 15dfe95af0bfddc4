"""`restart`: starts new chains from a draw."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Argument, Option

from flows.console import options
from flows.console.context import app, echo, graph_of, next_command, open_store
from flows.console.run import build_and_report
from flows.machine import cluster_settings
from flows.outcomes import Run
from flows.planning import PlanError, StageSelection
from flows.records import last_runs, last_sections
from flows.study import study_from_tree
from flows.study_files import HEAD, PUBLISH, StudyTree
from pasdedeux.errors import named
from pasdedeux.formats.pair_file import read_pair_json, write_pair_json
from storage_schema import Store
from tasks.files.user_files import read_file
from tasks.rows.draw_sets import REPAIRED
from tasks.seeds.files import DrawSeed, pair_of_draw
from tasks.stage.sweep import merged

_NO_OTHER_SEEDS = {"num_seeds": 0, "frames": [], "num_lifted": 0, "num_grown": 0, "num_starts": 0, "num_filled": 0}


@app.command()
def restart(
    context: typer.Context,
    draw: Annotated[str, Argument(metavar="DRAW", help="One draw: draws@key#row or draws:study/partition#row.")],
    settings: options.Settings = None,
    out: Annotated[Path, Option("--out", metavar="DIR", help="Folder for the file of the seed.")] = Path("restarts"),
    edited: Annotated[
        Path | None, Option(metavar="FILE", help="The edited JSON file of the draw, to use as seed.")
    ] = None,
    store: options.Store = Path("store"),
    workers: options.Workers = None,
    oversubscribe: options.Oversubscribe = False,
    as_json: options.Json = False,
) -> None:
    """Start new chains from a draw.

    This is the restart of Yin et al. 2018, section 5.3.

    Inspect the draws (`pasdedeux show draws:duets/ic-seed0#17`), choose one, and run

    \b
      pasdedeux restart draws:duets/ic-seed0#17
      pasdedeux restart draws@3fa9c1#17 --set chains.num_draws=5000

    The draw is written to a JSON file, which you can edit and name with --edited, and becomes the only seed of a new
    study with the settings of the original.  The study runs up to its chains; everything else is in the store already.
    The new draws keep the lineage: their seed names the draw, with its takes and credits.
    """
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
    if chosen.density in sweeps:  # named by a sweep, which samples the first of its densities
        tree["chains"] = merged(tree["chains"], sweeps[chosen.density])
        tree["chains"]["densities"] = tree["chains"]["densities"][:1]
    else:
        tree["chains"]["densities"] = [chosen.density.removesuffix(REPAIRED)]
    tree["chains"]["starts"] = "all"
    study, graph = study_from_tree(
        StudyTree(name, tree, {(): Path.cwd()}), graph_of(context), here=Path.cwd(), settings=settings or ()
    )
    if edited is None:
        out.mkdir(parents=True, exist_ok=True)
        path.write_text(write_pair_json(chosen.pair), encoding="utf-8")
    if not as_json:
        echo(f"the draw is the seed in {path}; its study is {name}")
    build_and_report(Run(study, graph, opened, StageSelection(until="chains")), cluster, as_json=as_json)
    if not as_json:
        echo(f"new draws: {next_command('show', f'draws:{name}', store=store)}")
        echo(f"how the chains went: {next_command('show', f'chain_info:{name}', store=store)}")


def _study_of(store: Store, chosen: DrawSeed) -> tuple[str, dict[str, Any]]:
    """Return the study that a draw comes from, with its recorded settings."""
    for last in last_runs(store):
        if chosen.ref in last.refs("chains") and (sections := last_sections(store, last)):
            return last.study, sections
    draw = f"draws@{chosen.ref.key[:12]}#{chosen.row}"
    command = next_command("export", draw, "--format", "json", "--out", "seeds", store=Path(str(store)))
    raise PlanError(
        f"draws@{chosen.ref.key[:12]} is of no study that is recorded in the store {store}, so "
        f"its settings are unknown.  Export it ({command}) and name the file in a study under seeds.files"
    )
