"""`complete`: fills in the unknown joints of a 3D pair from draws."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
from typer import Argument, Option

from flows.console import options
from flows.console.context import app, echo, open_store
from pasdedeux.completion.occlusion import NUM_NEAREST, complete_pair
from pasdedeux.errors import InputError, named
from pasdedeux.formats.pair_file import PairFile, PairSource, read_pair_json, write_pair_json
from pasdedeux.plain_text import counted
from storage_schema import parse_reference, resolve, source_credits
from tasks.files.user_files import read_file
from tasks.rows.draw_sets import read_all_draws
from tasks.stage.facts import merge_takes


@app.command()
def complete(
    file: Annotated[Path, Argument(metavar="FILE", help="JSON file of a pair.")],
    draws: Annotated[str, Option("--draws", metavar="REF", help="Draws or seeds: draws:study, seeds:study.")],
    num_nearest: Annotated[int, Option("--nearest", min=1, help="Number of nearest draws used.")] = NUM_NEAREST,
    out: Annotated[Path | None, Option("--out", metavar="FILE", help="The completed pair.")] = None,
    store: options.Store = Path("store"),
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
        completion = complete_pair(pair.pair_m, known.pairs_m, num_nearest=num_nearest)
    manifests = [opened.manifest(ref) for ref in refs]
    inherited = [PairSource(credit.name, credit.licence, credit.credit) for credit in source_credits(opened, *refs)]
    whole = PairFile(
        pair_m=completion.fitted_m,
        made_from=f"{pair.made_from or file.name}, completed by {draws}",
        takes=tuple(sorted({*pair.takes, *merge_takes(*manifests)})),
        sources=tuple(dict.fromkeys((*pair.sources, *inherited))),
    )
    target = out or file.with_name(f"{file.stem}_completed.json")
    target.write_text(write_pair_json(whole), encoding="utf-8")
    spread = np.linalg.norm(completion.neighbours.pairs_m - np.median(completion.neighbours.pairs_m, axis=0), axis=-1)
    for name, mask, apart in zip("AB", is_known, np.moveaxis(spread, 1, 0), strict=True):
        if not mask.all():
            far_cm = 100.0 * float(np.median(apart[:, ~mask]))
            echo(f"person {name}: {counted(int((~mask).sum()), 'joint')} completed, {far_cm:.1f} cm uncertain (median)")
    near_m = completion.neighbours.distance_m
    echo(f"{len(near_m)} of {counted(len(known.pairs_m), 'draw')} within {100 * near_m.max():.1f} cm (D_I)")
    echo(f"written: {target}")
