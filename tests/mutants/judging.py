"""Which tests run a mutant, and whether one of them notices it: they run in forks of this process, over a copy."""

from __future__ import annotations

import ast
import json
import math
import os
import re
import resource
import shutil
import signal
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from tests.mutants.drawing import Mutant

BUDGET_S = 15.0
"""Tests of a mutant run, the quick ones first, as long as all took together when they were recorded."""
MAX_CASES = 2
"""So many cases of a parametrised test come before the others."""
FILE_S = 0.3
"""Seconds that collecting one more file is worth."""
FIRST = 8
"""So many tests run before the files of all others are collected."""
PATIENCE = 20.0, 8.0
"""Tests have failed that take so many seconds of the processor, and so many times what they took, longer."""
COMPILING_S = 60.0
"""So much more time have tests of kernels, which are compiled anew for a mutant."""
MAX_WAIT = 6.0
"""A test has failed as well that takes so many times longer by the clock: others may be at work on the machine."""


@dataclass(frozen=True)
class Outcome:
    """`killed` by a test, `survived` a number of tests, or `not covered` by any."""

    word: str
    killer: str = ""
    num_tests: int = 0


class Tests:
    """What was recorded: the seconds of every test that passes and the lines that it runs."""

    def __init__(self, path: Path) -> None:
        self.seconds: dict[str, float] = {}
        self._by_line: dict[tuple[str, int], list[str]] = defaultdict(list)
        for record in map(json.loads, path.read_text().splitlines()):
            if record["passed"]:
                self.seconds[record["test"]] = record["s"]
                for file, lines in record["lines"].items():
                    for line in lines:
                        self._by_line[file, line].append(record["test"])

    def of(self, root: Path, mutant: Mutant) -> list[str]:
        """Return the tests that run the statement of a mutant, the quick ones first.

        A statement outside functions runs when its module is imported: its tests are those that run a function of the
        module, then of those that import it, and of those that import these, until there are some.
        """
        inside, lines = _statement(root / mutant.file, mutant.line)
        if inside:
            tests = {test for line in lines for test in self._by_line.get((mutant.file, line), ())}
            return self._in_order(tests, mutant.file)
        ordered: list[str] = []
        files, known = [mutant.file], {mutant.file}
        while files:
            found = {test for file in files for test in self._of_functions(root, file)} - set(ordered)
            ordered += self._in_order(found, mutant.file)
            if ordered and mutant.file not in files:
                break
            files = list({other for file in files for other in _importers(root, file)} - known)
            known |= set(files)
        return ordered

    def _of_functions(self, root: Path, file: str) -> set[str]:
        lines = _lines_of_functions(root / file)
        return {test for line in lines for test in self._by_line.get((file, line), ())}

    def _in_order(self, tests: set[str], module: str) -> list[str]:
        """Put quick tests first, further cases last; before others, files named like the module, or with many tests."""
        words = set(re.findall("[a-z0-9]+", module))
        files = Counter(test.partition("::")[0] for test in tests)
        alike = {file: len(words & set(re.findall("[a-z0-9]+", Path(file).stem))) for file in files}
        ranked = sorted(files, key=lambda file: (-alike[file], -files[file], file))
        places = {file: place for place, file in enumerate(ranked)}
        cost = {test: self.seconds[test] + FILE_S * places[test.partition("::")[0]] for test in tests}
        cases: Counter[str] = Counter()
        order = []
        for test in sorted(tests, key=lambda test: (cost[test], test)):
            cases[test.partition("[")[0]] += 1
            order.append((cases[test.partition("[")[0]] > MAX_CASES, len(order), test))
        return [test for *_, test in sorted(order)]


@cache
def _spans(path: Path) -> list[tuple[int, int, bool]]:
    """Return first and last line of each statement's own part, and whether it is inside a function."""
    spans = []

    def visit(node: ast.AST, inside: bool) -> None:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.stmt | ast.excepthandler):
                body = getattr(child, "body", None)
                last = body[0].lineno - 1 if body else child.end_lineno
                first = min([child.lineno, *(one.lineno for one in getattr(child, "decorator_list", ()))])
                spans.append((first, max(last or first, child.lineno), inside))
            visit(child, inside or isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef))

    visit(ast.parse(path.read_text()), False)
    return spans


def _statement(path: Path, line: int) -> tuple[bool, range]:
    around = [span for span in _spans(path) if span[0] <= line <= span[1]]
    first, last, inside = max(around, key=lambda span: (span[0], -span[1]), default=(line, line, False))
    return inside, range(first, last + 1)


@cache
def _lines_of_functions(path: Path) -> set[int]:
    return {line for first, last, inside in _spans(path) if inside for line in range(first, last + 1)}


@cache
def _texts(root: Path) -> dict[str, str]:
    folders = ("pasdedeux", "storage_schema", "tasks", "flows")
    return {
        path.relative_to(root).as_posix(): path.read_text() for name in folders for path in (root / name).rglob("*.py")
    }


@cache
def _importers(root: Path, file: str) -> list[str]:
    *above, name = Path(file).with_suffix("").parts
    package = ".".join(above)
    module = re.escape(package if name == "__init__" else f"{package}.{name}")
    imports = re.compile(rf"(from|import) {module}\b|from {re.escape(package)} import [^\n]*\b{name}\b")
    return [other for other, text in _texts(root).items() if other != file and imports.search(text)]


class Judge:
    """Runs tests over a copy of the sources in which one mutant at a time is planted.

    A test kills a mutant only if it passes without it, under the same limits.
    """

    def __init__(self, root: Path, tests: Tests, scratch: Path) -> None:
        self._root, self._tests = root, tests
        self._answer, self._log = scratch / "answer.json", scratch / "pytest.log"
        self._broken: set[str] = set()
        self._sound: set[str] = set()
        _import_heavy_packages()

    def judge(self, mutant: Mutant) -> Outcome:
        """Return what the tests of a mutant say."""
        waiting = self._tests.of(self._root, mutant)
        waiting = self._within_budget([test for test in waiting if test not in self._broken])
        more_s = COMPILING_S if _has_kernels(self._root / mutant.file) else 0.0
        num_run = 0
        while waiting:
            tests = waiting[:FIRST] if num_run == 0 else waiting
            with _planted(self._root, mutant):
                killer, num_passed = self._run(tests, more_s)
            num_run += num_passed
            waiting = waiting[num_passed:] if killer else waiting[len(tests) :]
            if killer is None:
                continue
            if killer in self._sound or self._run([killer], more_s)[0] is None:
                self._sound.add(killer)
                return Outcome("killed", killer, num_run + 1)
            self._broken.add(killer)
            waiting.remove(killer)
        return Outcome("survived" if num_run else "not covered", num_tests=num_run)

    def _within_budget(self, tests: list[str]) -> list[str]:
        left, chosen = BUDGET_S, []
        for test in tests:
            left -= self._tests.seconds[test]
            if chosen and left < 0:
                break
            chosen.append(test)
        return chosen

    def _run(self, tests: list[str], more_s: float) -> tuple[str | None, int]:
        """Return the first test that fails, or None, and the number of those before it that passed."""
        self._answer.write_text(json.dumps([tests[0], 0, "began"]))
        limits = {test: more_s + PATIENCE[0] + PATIENCE[1] * self._tests.seconds[test] for test in tests}
        processor_s = max(limits.values()) + PATIENCE[1] * sum(self._tests.seconds[test] for test in tests)
        limits = {test: MAX_WAIT * limit for test, limit in limits.items()}
        child = os.fork()
        if child == 0:
            resource.setrlimit(resource.RLIMIT_CPU, (math.ceil(processor_s), resource.RLIM_INFINITY))
            os._exit(_run_here(self._root, limits, self._answer, self._log))
        limit = 60.0 + max(limits.values())  # compiled code does not notice the signal that ends a test
        while os.waitpid(child, os.WNOHANG)[0] == 0:
            if time.time() - self._answer.stat().st_mtime > limit:
                with suppress(ProcessLookupError):
                    os.killpg(child, signal.SIGKILL)
            time.sleep(0.05)
        with suppress(ProcessLookupError):  # what the tests have started and left
            os.killpg(child, signal.SIGKILL)
        test, num_passed, word = json.loads(self._answer.read_text())
        return None if word == "passed" else test, num_passed


class _Chosen:
    """A plugin that runs the chosen tests in their order, each within its limit, and writes how far they came."""

    def __init__(self, limits: dict[str, float], answer: Path) -> None:
        self._limits, self._path, self._num_passed = limits, answer, 0

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        by_name = {item.nodeid: item for item in items}
        items[:] = [by_name[test] for test in self._limits if test in by_name]
        for item in items:
            item.add_marker(pytest.mark.timeout(self._limits[item.nodeid], method="signal"), append=False)

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        self._path.write_text(json.dumps([nodeid, self._num_passed, "began"]))

    def pytest_runtest_logreport(self, report: Any) -> None:
        if report.failed:
            self._path.write_text(json.dumps([report.nodeid, self._num_passed, "failed"]))
        elif report.when == "teardown":
            self._num_passed += 1

    def pytest_sessionfinish(self, exitstatus: int) -> None:
        if exitstatus == 0:
            self._path.write_text(json.dumps(["", self._num_passed, "passed"]))


def _run_here(root: Path, limits: dict[str, float], answer: Path, log: Path) -> int:
    os.setsid()
    handle = os.open(log, os.O_CREAT | os.O_WRONLY | os.O_TRUNC)
    for stream in (1, 2):
        os.dup2(handle, stream)
    os.chdir(root)
    os.environ["PYTHONPATH"] = str(root)
    sys.path.insert(0, str(root))
    for name in [name for name in sys.modules if name.partition(".")[0] == "tests"]:
        del sys.modules[name]
    files = list(dict.fromkeys(test.partition("::")[0] for test in limits))
    options = ["-q", "-x", "-p", "no:cacheprovider", "--hypothesis-profile", "planted"]
    options += ["-W", "ignore::pytest.PytestAssertRewriteWarning"]
    code = int(pytest.main([*options, *files], plugins=[_Chosen(limits, answer)]))
    sys.stdout.flush()
    return code


@contextmanager
def _planted(root: Path, mutant: Mutant) -> Iterator[None]:
    """Put a mutant in its place; kernels that it may change compile anew, and their code is gone afterwards."""
    path = root / mutant.file
    kept = path.with_suffix(".kept")
    text = mutant.text(root)
    shutil.copy2(path, kept)
    compiled = _code_of_kernels(root, mutant.file)
    for file in compiled:
        file.rename(f"{file}.kept")
    try:
        path.write_text(text)
        yield
    finally:
        kept.replace(path)
        for file in _code_of_kernels(root, mutant.file):
            file.unlink()
        for file in compiled:
            Path(f"{file}.kept").rename(file)


def _has_kernels(path: Path) -> bool:
    return any(word in path.read_text() for word in ("@compiled(", "@inner_kernel("))


def _code_of_kernels(root: Path, file: str) -> list[Path]:
    """Return what numba has kept of the kernels of a file and of all that import it, which may hold them."""
    if not _has_kernels(root / file):
        return []
    waiting, files = [file], {file}
    while waiting:
        found = set(_importers(root, waiting.pop())) - files
        waiting += found
        files |= found
    modules = [root / file for file in files]
    return [code for path in modules for code in path.parent.glob(f"__pycache__/{path.stem}.*.nb[ic]")]


def _import_heavy_packages() -> None:
    """Import what tests wait for, once; nothing of the packages themselves."""
    import anyio.pytest_plugin  # noqa: F401
    import cv2  # noqa: F401
    import distributed  # noqa: F401
    import fastapi.testclient  # noqa: F401
    import hypothesis.extra.numpy  # noqa: F401
    import numba  # noqa: F401
    import pandas  # noqa: F401
    import pyarrow.dataset
    import pyarrow.parquet  # noqa: F401
    import pydantic  # noqa: F401
    import scipy.optimize
    import scipy.signal
    import scipy.spatial
    import scipy.stats  # noqa: F401
    import torch  # noqa: F401
    import typer.testing  # noqa: F401
    import xdist.plugin  # noqa: F401
