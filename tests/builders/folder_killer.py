"""Writes a dataset's folder in child processes that die by SIGKILL, each some steps later than the last, then again.

Steps are those of `storage_killer`.  Prints a JSON object: the number of deaths, and what each rerun left that an
undisturbed call does not.

Usage: `python -m tests.builders.folder_killer fresh|update FOLDER`
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

from flows.dataset_folder import write_folder
from storage_schema import Store
from storage_schema.datasets import open_dataset
from storage_schema.keys import file_sha256
from tests.builders.storage_killer import die_at
from tests.builders.stored_datasets import VARIANTS, put_dataset

EVERY = 7
"""Steps from a death to the next."""


def digests(folder: Path) -> dict[str, str]:
    """Return all that lies in a folder."""
    return {str(path.relative_to(folder)): file_sha256(path) for path in folder.rglob("*") if path.is_file()}


def run(kind: str, folder: Path) -> dict[str, object]:
    """Write a dataset, or the next version over the last one, dying every few steps."""
    store = Store(folder / "store")
    put_dataset(store, {"hug": False}, num_frames=3, variants=VARIANTS[:1])
    put_dataset(store, {"hug": False, "judo": False}, num_frames=3, variants=VARIANTS[:1])
    first, second = open_dataset(store, "made@1"), open_dataset(store, "made@2")

    def prepare(root: Path) -> Path:
        root.mkdir()
        if kind == "update":
            write_folder(store, first, root / "out")
        return root

    def act(root: Path) -> None:
        write_folder(store, second, root / "out", since="made@1" if kind == "update" else "")

    quiet = prepare(folder / "undisturbed")
    act(quiet)
    expected, differing, step = digests(quiet / "out"), [], 0
    while True:
        root = prepare(folder / str(step))
        child = os.fork()
        if child == 0:
            die_at(step, root)
            act(root)
            os._exit(0)
        _, status = os.waitpid(child, 0)
        before = digests(root / "out") if (root / "out").is_dir() else None
        is_old_or_new = before in (None, expected) or kind == "update"
        act(root)
        left = sorted(path.name for path in root.iterdir() if path.name != ".out.lock")
        if digests(root / "out") != expected or left != ["out"] or not is_old_or_new:
            differing.append([step, left])
        if os.WIFEXITED(status):
            return {"deaths": step // EVERY, "exit": os.WEXITSTATUS(status), "differing": differing}
        step += EVERY


if __name__ == "__main__":
    sys.stdout.write(json.dumps(run(sys.argv[1], Path(sys.argv[2]))))
