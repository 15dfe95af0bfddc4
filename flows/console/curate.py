"""`curate`: accepts or rejects items in the file of choices, which studies and `view` read too."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Literal

from typer import Argument, Option

from flows.console import options
from flows.console.context import app, echo, open_store
from flows.viewing.curating import thing_of
from flows.viewing.shelf import open_shelf
from pasdedeux.errors import InputError
from storage_schema import parse_reference
from storage_schema.references import find_rows
from tasks.files.curation import Choosing

CURATION = Path("curation.txt")
CurationOption = Annotated[Path, Option("--curation", metavar="FILE", help="File of choices; made when missing.")]


@app.command()
def curate(
    decision: Annotated[Literal["accept", "reject", "undo"], Argument(help="The choice; undo forgets it.")],
    reference: Annotated[str, Argument(metavar="REF", help="Any row of the item: variants:study/take#row.")],
    reason: Annotated[str, Option("--reason", metavar="TEXT", help="Why, for later readers.")] = "",
    frames: Annotated[
        str | None, Option(metavar="FIRST-LAST", help="Only this clip of a motion (frames of the video).")
    ] = None,
    curation: CurationOption = CURATION,
    store: options.Store = Path("store"),
) -> None:
    """Accept or reject a variant, draw, seed, lifted pair, take, sequence or reconstructed motion.

    \b
      pasdedeux curate reject "variants:duets/waltz#120" --reason "feet slide"
      pasdedeux curate undo "variants:duets/waltz#120"
      pasdedeux curate reject "motions:duets/waltz#0" --frames 30-45

    Rows are counted from 0, as in `show`.  A variant has a row for each frame and person; any of its rows selects the
    whole variant.  The output names what was selected.  The file has a line for each choice, with name, content
    digest and reason.  If a study names the file (`[curation] file`), exports, training and published datasets leave
    out rejected items while their content stays the same.  `export --curation FILE` uses it without a study.
    """
    clip = re.fullmatch(r"(\d+)-(\d+)", frames) if frames is not None else None
    if frames is not None and clip is None:
        raise InputError(f"--frames {frames}: a clip is FIRST-LAST in frames of the video, such as 30-45")
    opened = open_store(store)
    shelf = open_shelf(opened, reference)

    def thing(text: str) -> tuple[str, str, str]:
        part, index, row = shelf.find(text)
        only = None if clip is None else (int(clip[1]), int(clip[2]))
        return part.table, *thing_of(shelf, part, shelf.items(part)[index], row, only)

    meant = thing(reference)
    if (parsed := parse_reference(reference)).row is None:
        num_rows = sum(rows.stop for _, rows in find_rows(parsed, opened))
        if (last := thing(f"{reference}#{num_rows - 1}")) != meant:
            raise InputError(
                f"'{reference}' names several things, {meant[1]} (row 0) to {last[1]} (row {num_rows - 1}); add a row "
                f"of the one that is meant, such as '{reference}#0'"
            )
    echo(Choosing(curation).decide(decision, *meant, reason))
    if decision == "reject":
        echo(f"exports leave it out with --curation {curation}, or if the study names the file ([curation] file)")
