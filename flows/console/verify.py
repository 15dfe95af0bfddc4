"""`verify`: compares every file of a store with its manifest."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import typer

from flows.console import options
from flows.console.context import answer, app, existing_store
from flows.console.display import size_text
from pasdedeux.plain_text import counted
from storage_schema import verify as verify_store
from storage_schema.manifest import RESERVED_NAMES
from storage_schema.verification import ProblemKind


@app.command()
def verify(store: options.Store = Path("store"), as_json: options.Json = False) -> None:
    """Read every file of the store and compare it with its manifest; exit code 1 if anything is wrong."""
    opened = existing_store(store)
    audit = verify_store(opened)
    size = (
        f"{counted(audit.num_artifacts, 'artifact')}, {counted(audit.num_files, 'file')}, {size_text(audit.num_bytes)}"
    )
    lines = [*map(str, audit.problems), *(f"note: {note}" for note in audit.notes)]
    lines.append(
        f"{size}: " + ("all match their manifests" if audit.is_ok else counted(len(audit.problems), "problem"))
    )
    damaged = {problem.stage for problem in audit.problems if problem.kind is not ProblemKind.EXTRA}
    if stages := sorted(damaged - RESERVED_NAMES):
        force = " ".join(f"--force {stage}" for stage in stages)
        lines.append(f"`pasdedeux run STUDY {force}` recomputes what is damaged")
    described = {"is_ok": audit.is_ok, **asdict(audit), "problems": [str(problem) for problem in audit.problems]}
    answer(described, lines, as_json=as_json)
    if not audit.is_ok:
        raise typer.Exit(1)
