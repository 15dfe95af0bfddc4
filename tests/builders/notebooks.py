"""Notebooks of the examples, executed as a reader would, with other parameters."""

from __future__ import annotations

import os
from pathlib import Path

import nbformat
from nbclient import NotebookClient

from tests.builders.toy_runs import ROOT


def run_notebook(name: str, given: str, folder: Path) -> str:
    """Execute an example, kept without outputs, with these parameters in a folder; return what its cells show."""
    notebook = nbformat.read(ROOT / "examples" / name, as_version=4)
    nbformat.validate(notebook)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert all(not cell.outputs and cell.execution_count is None for cell in code)
    (parameters,) = (cell for cell in code if "parameters" in cell.metadata.get("tags", ()))
    parameters.source = given
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    NotebookClient(notebook, timeout=600).execute(env=environment, cwd=str(folder))
    outputs = (output for cell in code for output in cell.outputs)
    return "\n".join(str(output.get("text", output.get("data", {}).get("text/plain", ""))) for output in outputs)
