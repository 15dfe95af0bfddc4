"""`view`: shows a store or motion files in a browser."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from flows.console import options
from flows.console.context import app, echo, open_store
from flows.console.curate import CURATION, CurationOption
from flows.console.inputs import UnitOption, find_take
from flows.viewing.editing import Editor
from flows.viewing.own_joints import open_own_joints
from flows.viewing.shelf import Shelf, open_shelf
from flows.viewing.viewer import Viewer
from pasdedeux.errors import InputError
from tasks.files.curation import Choosing


@app.command()
def view(
    what: Annotated[
        list[str] | None,
        Argument(
            metavar="[REF|RUN|FILE ...]", help="Study, reference, run, dataset, or a motion file for each person."
        ),
    ] = None,
    store: options.Store = Path("store"),
    port: Annotated[int, Option(min=0, max=65535, help="Port of this machine; 0 takes any that is free.")] = 8080,
    workers: options.Workers = None,
    curation: CurationOption = CURATION,
    unit: UnitOption = None,
) -> None:
    """Look at takes, draws, pairs, reconstructions and variants in a browser.

    \b
      pasdedeux view                             the study that ran last
      pasdedeux view variants:duets/waltz        one part of it
      pasdedeux view "draws:duets/ic-seed0#17"   at one moment
      pasdedeux view a.bvh b.bvh                 motion files, one for each person

    Keys: space plays; left and right step by a frame; up and down change the item; Home and End go to the first and
    last frame; F goes to the next frame that fails. K accepts and X rejects the item for exports and training
    (`curate`); for a reconstruction, I and O mark a clip first.

    Only this machine can open the page; from another, run `ssh -L 8080:127.0.0.1:8080 HOST` first.  Ctrl-C ends it.
    """
    words = what or []
    with contextlib.ExitStack() as held:
        if len(words) > 1 or (words and Path(words[0]).is_file()):
            try:
                opened, ref = held.enter_context(find_take(words, store, unit or (), None))
                shelf, at = Shelf(opened, [ref]), None
            except InputError as error:
                shelf, at = held.enter_context(open_own_joints(words, unit or (), error)), None
        else:
            shelf = open_shelf(open_store(store), words[0] if words else None)
            at = words[0] if words and "#" in words[0] else None
        viewer = Viewer(shelf, port=port, at=at, choosing=Choosing(curation))
        Editor(viewer, Path("restarts"), workers)
        echo(f"{viewer.url} shows it; Ctrl-C ends it")
        with contextlib.suppress(KeyboardInterrupt):
            viewer.ended.wait()
        viewer.stop()
