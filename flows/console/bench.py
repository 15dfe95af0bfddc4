"""`bench`: runs the benchmarks in `benchmarks/` of a checkout."""

from __future__ import annotations

import importlib
import os
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

from typer import Argument

from flows.console import options
from flows.console.context import answer, app, echo
from flows.planning import PlanError
from tasks.shards import worker_environment

_ROOT = Path(__file__).parents[2]
"""The folder of the checkout, or site-packages."""


@app.command()
def bench(
    stage: Annotated[
        str | None,
        Argument(
            metavar="[STAGE]",
            help="One stage, loader, scale, full-scale or commands; default: all stages, loader, scale.",
        ),
    ] = None,
    as_json: options.Json = False,
) -> None:
    """Measure kernels or whole commands against a plain implementation; needs a checkout.

    \b
      pasdedeux bench              kernels of all stages
      pasdedeux bench chains       kernels of one stage
      pasdedeux bench loader       training windows, beside pyarrow and `datasets`
      pasdedeux bench scale        how cost grows with size
      pasdedeux bench full-scale   to 10,000,000 projections, 1,000,000
                                   annotations and 100 takes; takes minutes
      pasdedeux bench commands     `status`, and the demo, three times; minutes
    """
    if not (_ROOT / "benchmarks" / "registry.py").is_file():
        raise PlanError("benchmarks are not installed: run this command in a checkout (`pip install --editable .`)")
    os.environ.update(worker_environment())
    registry = importlib.import_module("benchmarks.registry")  # imported by name, as it is not installed
    results = registry.run_benchmarks(stage, lambda text: echo(text, err=True))
    described = [{"stage": name, **asdict(result), "ratio": result.ratio} for name, result in results]
    answer(described, registry.table([result for _, result in results]), as_json=as_json)
