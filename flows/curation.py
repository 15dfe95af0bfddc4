"""The choices that hold for what a reference names: those of its study or of its version of a dataset."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from flows.records import STUDY_FILE, last_sections, read_last_run
from storage_schema import Reference, Store
from storage_schema.datasets import open_dataset
from tasks.curation import choices_in

SECTION = "curation"


def choices_for(store: Store, reference: Reference, file: Path | None = None) -> dict[str, str]:
    """Return choices as a study has them: of this file, else of a study as its file says now, of a dataset as it was.

    Raises:
        InputError: The file is not there, or holds something else.
    """
    if file is not None:
        return choices_in(file)
    if reference.dataset:
        return recorded_choices(open_dataset(store, reference.dataset).path)
    if not reference.study:
        return {}
    section = last_sections(store, read_last_run(store, reference.study)).get(SECTION, {})
    path = section.get("file")
    return choices_in(Path(path)) if path and Path(path).is_file() else section.get("choices", {})


def recorded_choices(folder: Path) -> dict[str, str]:
    """Return the choices that went with a dataset in this folder; none where its study is not with it."""
    path = folder / STUDY_FILE
    sections: dict[str, Any] = json.loads(path.read_bytes()) if path.is_file() else {}
    found: dict[str, str] = sections.get(SECTION, {}).get("choices", {})
    return found
