"""`complete`: joints that a 3D pair lacks, from draws of a store."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from flows.console.context import StoreOption, open_store

app = typer.Typer(rich_markup_mode=None)

_COMPLETE = """Complete a 3D pair whose joints are not all known, as a depth camera gives it (Yin et al. 2018, Fig. 12).

\b
  pasdedeux complete pair.json --draws draws:duets
  pasdedeux complete pair.json --draws seeds:mine --out whole.json

FILE is a pair as `pasdedeux export seeds:... --format json` writes it; a joint that is not known is left out or null,
and one person may lack all of theirs.  The draws that are nearest over the known joints say where the others are; bone
lengths are those that are known, or the draws'.  The answer says of every person how far those draws lie apart.
"""


@app.command(help=_COMPLETE)
def complete(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="JSON file of a pair.")],
    draws: Annotated[
        str, typer.Option("--draws", metavar="REF", help="Draws or grown seeds: draws:study, draws@key, seeds:study.")
    ],
    num_nearest: Annotated[int, typer.Option("--nearest", min=1, help="Nearest draws that are asked.")] = 100,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="The completed pair; FILE_completed.json if not given.")
    ] = None,
    store: StoreOption = Path("store"),
) -> None:
    """Complete a pair."""
    import numpy as np

    from pasdedeux.completion.occlusion import complete_pair
    from pasdedeux.errors import InputError
    from pasdedeux.formats.pair_file import PairFile, PairSource, read_pair_json, write_pair_json
    from storage_schema import parse_reference, resolve, source_credits
    from tasks.draw_sets import read_all_draws
    from tasks.stage import merge_takes

    opened = open_store(store)
    reference = parse_reference(draws)
    if reference.table not in ("draws", "seeds"):
        raise InputError(f"--draws: '{draws}' names no draws; draws:study, draws@key or seeds:study do")
    refs = resolve(reference, opened)
    try:
        pair = read_pair_json(file.read_bytes(), is_partial=True)
        is_known = np.asarray(np.isfinite(pair.pair_m).all(axis=-1))
        if is_known.all():
            raise InputError("no joint is missing; one that is not known is left out, or null")
        known = read_all_draws(opened, refs)
        count = min(num_nearest, len(known.pairs_m))
        found = complete_pair(pair.pair_m, known.pairs_m, num_nearest=count, num_ranked=2 * count)
    except InputError as error:
        raise type(error)(f"{file.name}: {error}") from None
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
            typer.echo(f"person {name}: {int((~own).sum())} joints completed, {far_cm:.1f} cm uncertain (median)")
    typer.echo(f"{count} of {len(known.pairs_m)} draws within {100 * found.neighbours.distance_m.max():.1f} cm (D_I)")
    typer.echo(f"written: {target}")
