"""Plant faults in a copy of the sources, one at a time, and tell whether the test named with each of them notices.

`python -m tests.planted_faults [WORD ...]`: all faults, or those whose name or file has one of the words.  Exit code 1
where a fault survives, or a test fails without one.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path

from tests.planted_faults.faults import FAULTS, Fault

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("pasdedeux", "storage_schema", "tasks", "flows")
LIMIT_S = 900.0
_FAILED = re.compile(r"^(?:FAILED|ERROR) tests/\S+?::(\S+)", re.MULTILINE)


def main(words: list[str]) -> int:
    chosen = [one for one in FAULTS if not words or any(word in f"{one.name} {one.file}" for word in words)]
    say(f"{len(chosen)} faults; first the tests without any")
    with tempfile.TemporaryDirectory() as folder:
        code, failed = run_tests(copy_sources(Path(folder)), {one.test for one in chosen})
    if code != 0:
        say(f"they fail without a fault (pytest ends with {code}): {', '.join(failed) or 'none could be run'}")
        return 1
    survived = []
    for number, fault in enumerate(chosen, start=1):
        began, caught_by = time.monotonic(), plant(fault)
        word, seconds = "caught" if caught_by else "SURVIVED", time.monotonic() - began
        say(f"{number:3} of {len(chosen)}  {word:8}  {seconds:4.0f} s  {fault.name}  <- {caught_by or fault.test}")
        survived += [] if caught_by else [fault]
    say(f"{len(chosen) - len(survived)} of {len(chosen)} faults are caught")
    for fault in survived:
        say(f"SURVIVED {fault.name} ({fault.file}): {fault.test} does not notice it")
    return 1 if survived else 0


def plant(fault: Fault) -> str:
    """Return the first test that fails with a fault, in a copy of its own; empty where none does or can be run."""
    with tempfile.TemporaryDirectory() as folder:
        root = copy_sources(Path(folder))
        (root / fault.file).write_text(fault.planted_in((root / fault.file).read_text()))
        forget_kernels(root, root / fault.file)
        code, failed = run_tests(root, [fault.test])
    return failed[0] if code == 1 and failed else ""


def run_tests(root: Path, tests: Iterable[str]) -> tuple[int, list[str]]:
    """Run tests of a copy until one fails; gives what pytest ends with and the test that failed."""
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "--hypothesis-profile", "planted"]
    command += [f"tests/{test}" for test in sorted(tests)]
    environment = {**os.environ, "PYTHONPATH": str(root)}
    try:
        done = subprocess.run(
            command, cwd=root, env=environment, capture_output=True, text=True, timeout=LIMIT_S, check=False
        )
    except subprocess.TimeoutExpired:
        return 124, []
    return done.returncode, _FAILED.findall(done.stdout)


def copy_sources(folder: Path) -> Path:
    """Copy the sources with their compiled kernels, which are known to be valid by the time of a file's last change."""
    away = shutil.ignore_patterns(".*", "store", "build", "dist", "*.egg-info")
    return Path(shutil.copytree(ROOT, folder / "copy", ignore=away, copy_function=shutil.copy2))


def forget_kernels(root: Path, changed: Path) -> None:
    """Remove the compiled kernels of all modules that read a changed one: numba looks at a kernel's own file only."""
    texts = {path: path.read_text() for name in PACKAGES for path in (root / name).rglob("*.py")}
    stale, waiting = set(), [changed]
    while waiting:
        path = waiting.pop()
        stale.add(path)
        *above, name = path.relative_to(root).with_suffix("").parts
        package = ".".join(above)
        module = package if name == "__init__" else f"{package}.{name}"
        reads = re.compile(rf"(from|import) {re.escape(module)}\b|from {re.escape(package)} import [^\n]*\b{name}\b")
        waiting += [
            other
            for other, text in texts.items()
            if other not in stale and ("@compiled" in text or other.name == "__init__.py") and reads.search(text)
        ]
    for path in stale:
        for kernel in (path.parent / "__pycache__").glob(f"{path.stem}.*.nb[ic]"):
            kernel.unlink()


def say(line: str) -> None:
    print(line, flush=True)  # noqa: T201


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
