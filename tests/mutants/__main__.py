"""Draw mutants of the committed packages and tell how many of them the tests notice.

`python -m tests.mutants [--number 100] [--seed 0] [--packages tasks flows]`.  Which tests run which lines is recorded
once for a commit, in `.mutants/`; there, each judged mutant is a line of a file as well, so that a stopped run goes on
where it was.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import subprocess
import sys
import tarfile
from collections import Counter
from dataclasses import asdict
from pathlib import Path

from tests.mutants.drawing import Mutant, draw
from tests.mutants.judging import Judge, Outcome, Tests

PACKAGES = ("pasdedeux", "storage_schema", "tasks", "flows")
FOLDERS = ("unit", "golden", "contract", "property", "statistical", "fault")
"""Of these folders, the tests that are not slow: those of whole studies take longer than a mutant is worth."""
ROOT = Path(__file__).resolve().parents[2]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--number", type=int, default=100, help="how many mutants (100)")
    parser.add_argument("--seed", type=int, default=0, help="another seed draws others (0)")
    parser.add_argument(
        "--packages", nargs="+", choices=PACKAGES, default=PACKAGES, metavar="PACKAGE", help="draw only in these (all)"
    )
    arguments = parser.parse_args()
    packages = tuple(name for name in PACKAGES if name in arguments.packages)
    commit = _said("git", "rev-parse", "--short=12", "HEAD")
    folder = ROOT / ".mutants" / commit
    copy, lines = folder / "copy", folder / "lines.jsonl"
    if not copy.exists():
        _copy_committed(copy)
    if not lines.exists():
        say("recording which tests run which lines, once for this commit")
        _record(copy, lines)
    named = "" if packages == PACKAGES else f"-{'-'.join(packages)}"
    results = folder / f"seed-{arguments.seed}{named}.jsonl"
    known = [json.loads(line) for line in results.read_text().splitlines()] if results.exists() else []
    judge = Judge(copy, Tests(lines), folder)
    mutants = draw(copy, packages, arguments.number, arguments.seed)
    outcomes = [Outcome(**entry["outcome"]) for entry in known[: len(mutants)]]
    for number, mutant in enumerate(mutants[len(outcomes) :], start=len(outcomes) + 1):
        outcome = judge.judge(mutant)
        outcomes.append(outcome)
        with results.open("a") as handle:
            handle.write(json.dumps({"mutant": asdict(mutant), "outcome": asdict(outcome)}) + "\n")
        say(f"{number:4} {outcome.word:11} {mutant.file}:{mutant.line} {mutant.operator}  {outcome.killer}")
        if outcome.word != "killed":
            say(mutant.difference(copy))
    say(table(mutants, outcomes))


def table(mutants: list[Mutant], outcomes: list[Outcome]) -> str:
    """Return the counts of each package, and the share of the judged that is killed with Wilson's interval."""
    from scipy.stats import binomtest

    counts = Counter(
        (mutant.file.split("/")[0], outcome.word) for mutant, outcome in zip(mutants, outcomes, strict=True)
    )
    rows = [f"{'':15}{'killed':>8}{'survived':>10}{'not covered':>13}{'killed, %':>11}  (95 %)"]
    for name, packages in [*((package, (package,)) for package in PACKAGES), ("all", PACKAGES)]:
        killed, survived, uncovered = (
            sum(counts[package, word] for package in packages) for word in ("killed", "survived", "not covered")
        )
        if total := killed + survived + uncovered:
            low, high = binomtest(killed, total).proportion_ci(method="wilson")
            share = f"{100 * killed / total:11.0f}  ({100 * low:.0f}-{100 * high:.0f})"
            rows.append(f"{name:15}{killed:8}{survived:10}{uncovered:13}{share}")
    return "\n".join(rows)


def _copy_committed(copy: Path) -> None:
    copy.mkdir(parents=True)
    archive = subprocess.run(["git", "archive", "HEAD"], cwd=ROOT, capture_output=True, check=True).stdout
    with tarfile.open(fileobj=io.BytesIO(archive)) as files:
        files.extractall(copy, filter="data")


def _record(copy: Path, lines: Path) -> None:
    part = lines.with_suffix(".part")
    part.unlink(missing_ok=True)
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "tests.mutants.recording"]
    command += ["-m", "not slow", "--timeout", "150", *(f"tests/{folder}" for folder in FOLDERS)]
    environment = {**os.environ, "PYTHONPATH": str(copy), "PASDEDEUX_LINES_OF_TESTS": str(part)}
    subprocess.run(command, cwd=copy, env=environment, check=False)  # a test that fails is recorded as such
    part.rename(lines)


def _said(*command: str) -> str:
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()


def say(line: str) -> None:
    print(line, flush=True)  # noqa: T201


if __name__ == "__main__":
    main()
