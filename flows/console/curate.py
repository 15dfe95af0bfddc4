"""`curate`: accept or reject what a reference names, in the file of choices that a study and `view` share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer
from typer import Argument, Option

from flows.console.context import StoreOption, app, open_store
from pasdedeux.errors import InputError
from storage_schema import parse_reference

CURATION = Path("curation.txt")
CurationOption = Annotated[Path, Option("--curation", metavar="FILE", help="File of choices; made when missing.")]


@app.command()
def curate(
    decision: Annotated[Literal["accept", "reject", "undo"], Argument(help="What is decided; undo forgets it.")],
    reference: Annotated[str, Argument(metavar="REF", help="One row of what it is about: variants:study/take#row.")],
    reason: Annotated[str, Option("--reason", metavar="TEXT", help="Why, for those who read it later.")] = "",
    curation: CurationOption = CURATION,
    store: StoreOption = Path("store"),
) -> None:
    """Accept or reject a variant, draw, seed, lifted pair, take, sequence or reconstructed motion.

    \b
      pasdedeux curate reject "variants:duets/waltz#120" --reason "feet slide"
      pasdedeux curate undo "variants:duets/waltz#120"

    The file has a line a choice: name and content of the thing, and the reason.  Name it in a study
    (`[curation] file`): exports, training and published datasets then leave out what is rejected, as long as its
    content is the same.
    """
    from flows.viewing.kinds import thing_of
    from flows.viewing.shelf import open_shelf
    from tasks.curation import Choosing

    if parse_reference(reference).row is None:
        raise InputError(f"'{reference}' may name more than one thing: name one row of it: {reference}#ROW")
    shelf = open_shelf(open_store(store), reference)
    part, index, row = shelf.find(reference)
    name, content = thing_of(shelf, part, shelf.items(part)[index], row)
    typer.echo(Choosing(curation).decide(decision, part.table, name, content, reason))
