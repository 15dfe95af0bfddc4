"""`restart`: goes on from a draw that somebody liked, as the seed of new chains."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from flows.console.context import (
    JsonOption,
    OversubscribeOption,
    SettingOption,
    StoreOption,
    WorkersOption,
    graph_of,
    next_command,
    open_store,
)
from flows.console.run import build_and_report
from flows.machine import cluster_settings
from flows.planning import PlanError, Selection
from flows.records import last_sections, read_last_run
from flows.study import study_from_tree
from flows.study_files import PUBLISH, StudyTree
from storage_schema import Store, latest_studies

if TYPE_CHECKING:
    from tasks.seeds.files import DrawSeed

app = typer.Typer(rich_markup_mode=None)

_RESTART = """Go on from a draw: new chains that start where it is (Yin et al. 2018, section 5.3).

Look through the draws (`pasdedeux show draws:duets/ic-seed0#17`), choose one, and

\b
  pasdedeux restart draws:duets/ic-seed0#17
  pasdedeux restart draws@3fa9c1#17 --draws 5000 --chains 4
  pasdedeux restart draws@3fa9c1#17 --set chains.proposal=velocity

The draw is written to a file (JSON, for editing too).  The file becomes the only seed of a study of its own, named
after the one that the draw is from and with the same settings otherwise; that is run until its chains are there.  What
it needs of the first study is in the store already.  The new draws carry the lineage: the seed they start from names
the draw, and the takes and credits of the draw are theirs.
"""
_NO_OTHER_SEEDS = {"num_seeds": 0, "frames": [], "num_lifted": 0, "num_grown": 0, "num_starts": 0}


@app.command(help=_RESTART)
def restart(
    context: typer.Context,
    draw: Annotated[str, typer.Argument(metavar="DRAW", help="One draw: draws@key#row or draws:study/partition#row.")],
    num_draws: Annotated[
        int | None, typer.Option("--draws", min=1, help="Draws of each new chain; as many as before when not given.")
    ] = None,
    num_chains: Annotated[
        int | None, typer.Option("--chains", min=1, help="New chains; as many as before when not given.")
    ] = None,
    settings: SettingOption = None,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the seed's file.")] = Path("restarts"),
    store: StoreOption = Path("store"),
    workers: WorkersOption = None,
    oversubscribe: OversubscribeOption = False,
    as_json: JsonOption = False,
) -> None:
    """Go on from a draw."""
    from pasdedeux.formats.pair_file import write_pair_json
    from tasks.seeds.files import pair_of_draw

    cluster = cluster_settings(workers, oversubscribe=oversubscribe)
    opened = open_store(store)
    chosen = pair_of_draw(opened, draw)
    origin, sections = _study_of(opened, chosen)
    path = out / f"draw-{chosen.ref.key[:12]}-{chosen.row}.json"
    name = f"{origin}-restart-{chosen.ref.key[:12]}-{chosen.row}"
    tree = _restarted(sections, chosen, name, path.resolve())
    tree.pop(PUBLISH, None)
    if num_draws is not None:
        tree["chains"]["num_draws"] = num_draws
    if num_chains is not None:
        tree["chains"]["num_chains"] = num_chains
    study, graph = study_from_tree(
        StudyTree(name, tree, {(): Path.cwd()}), graph_of(context), here=Path.cwd(), settings=settings or ()
    )
    out.mkdir(parents=True, exist_ok=True)
    path.write_text(write_pair_json(chosen.pair), encoding="utf-8")
    if not as_json:
        typer.echo(f"the draw is the seed in {path}; its study is {name}")
    build_and_report(study, graph, opened, Selection(until="chains"), cluster, as_json=as_json)
    if not as_json:
        typer.echo(f"new draws: {next_command('show', f'draws:{name}', store=store)}")
        typer.echo(f"how the chains went: {next_command('show', f'chain_info:{name}', store=store)}")


def _study_of(store: Store, chosen: DrawSeed) -> tuple[str, dict[str, Any]]:
    """Return the study that a draw is from, with its settings as they were."""
    for study in latest_studies(store):
        last = read_last_run(store, study)
        if last is None or chosen.ref not in last.refs("chains"):
            continue
        sections = last_sections(store, last)
        if sections:
            return study, sections
    draw = f"draws@{chosen.ref.key[:12]}#{chosen.row}"
    command = next_command("export", draw, "--format", "json", "--out", "seeds", store=Path(str(store)))
    raise PlanError(
        f"draws@{chosen.ref.key[:12]} belongs to no study that is on record in the store {store}: "
        f"its settings are not known.  Export it ({command}) and name the file in a study under seeds.files"
    )


def _restarted(sections: dict[str, Any], chosen: DrawSeed, name: str, path: Path) -> dict[str, Any]:
    """Return a study's settings with the draw as its only seed."""
    tree: dict[str, Any] = {section: dict(values) for section, values in sections.items()}
    tree["study"] |= {"name": name, "title": f"Restart from draws@{chosen.ref.key[:12]}#{chosen.row}"}
    if tree["study"].get("stages") is None:
        tree["study"].pop("stages", None)
    tree["seeds"] |= {**_NO_OTHER_SEEDS, "files": [{"path": str(path)}]}
    tree["chains"] |= {"densities": [chosen.density]}
    return tree
