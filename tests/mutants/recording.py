"""A plugin of pytest that writes which lines of the packages each test runs: one JSON line for a test.

What a fixture of a module or session does counts for all tests that ask for it.  Compiled kernels run outside Python:
a test that calls one is taken to run all lines of it and of the kernels that it calls.
"""

from __future__ import annotations

import json
import os
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import coverage
import pytest

PACKAGES = ("pasdedeux", "storage_schema", "tasks", "flows")
_OUTSIDE = "collection"


class Recording:
    """Lines by test: contexts of coverage for what Python runs, calls of kernels for what numba compiled."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._root = Path.cwd()
        self._coverage = coverage.Coverage(data_file=None, config_file=False, source=list(PACKAGES))
        self._coverage.set_option("run:disable_warnings", ["no-data-collected"])  # by a file of which all is skipped
        self._coverage.start()
        self._context = [_OUTSIDE]
        self._kernels: dict[str, set[Any]] = defaultdict(set)
        self._shared: dict[str, dict[str, set[int]]] = {}
        self._waiting: list[tuple[str, list[str], float, bool]] = []
        self._listen_to_kernels()

    def _listen_to_kernels(self) -> None:
        from pasdedeux.compiled import _Kernel

        call = _Kernel.__call__

        def noted_call(kernel: Any, *arguments: Any, **named: Any) -> Any:
            self._kernels[self._context[-1]].add(kernel)
            return call(kernel, *arguments, **named)

        _Kernel.__call__ = noted_call  # type: ignore[method-assign]

    def _enter(self, context: str) -> None:
        self._context.append(context)
        self._coverage.switch_context(context)

    def _leave(self) -> None:
        self._context.pop()
        self._coverage.switch_context(self._context[-1])

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: Any, request: Any) -> Iterator[None]:
        """Keep what a shared fixture runs apart from the test that happens to be the first to ask for it."""
        if fixturedef.scope == "function":
            return (yield)
        self._enter(f"{fixturedef.baseid}::{fixturedef.argname}")
        try:
            return (yield)
        finally:
            self._leave()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item, nextitem: pytest.Item | None) -> Iterator[None]:
        """Record a test; its lines are written when its file ends, since reading them from coverage takes time."""
        self._seconds, self._passed = 0.0, True
        self._enter(item.nodeid)
        try:
            answer = yield
        finally:
            self._leave()
        asked = [
            f"{definition.baseid}::{name}"
            for name, definitions in item._fixtureinfo.name2fixturedefs.items()
            for definition in definitions
            if definition.scope != "function"
        ]
        self._waiting.append((item.nodeid, asked, self._seconds, self._passed))
        if nextitem is None or nextitem.path != item.path:
            self._write()
        return answer

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Add the time of a phase; only a test that passes can notice a fault."""
        self._seconds += report.duration
        self._passed &= report.passed

    def _write(self) -> None:
        self._coverage.stop()
        data = self._coverage.get_data()
        lines: dict[str, dict[str, set[int]]] = defaultdict(lambda: defaultdict(set))
        for file in data.measured_files():
            name = os.path.relpath(file, self._root)
            for line, contexts in data.contexts_by_lineno(file).items():
                for context in contexts:
                    lines[context][name].add(line)
        for context, kernels in self._kernels.items():
            for kernel in _with_called(kernels):
                code = kernel._function.__code__
                name = os.path.relpath(code.co_filename, self._root)
                lines[context][name] |= {line for _, _, line in code.co_lines() if line}
        tests = {name for name, *_ in self._waiting}
        self._shared.update({context: found for context, found in lines.items() if context not in tests})
        with self._path.open("a") as handle:
            for name, asked, seconds, passed in self._waiting:
                together: dict[str, set[int]] = defaultdict(set)
                for part in (lines[name], *(self._shared.get(context, {}) for context in asked)):
                    for file, numbers in part.items():
                        together[file] |= numbers
                record = {file: sorted(numbers) for file, numbers in together.items()}
                handle.write(
                    json.dumps({"test": name, "s": round(seconds, 3), "passed": passed, "lines": record}) + "\n"
                )
        self._waiting.clear()
        self._kernels.clear()
        self._coverage.erase()
        self._coverage.start()
        self._coverage.switch_context(self._context[-1])


def _with_called(kernels: set[Any]) -> set[Any]:
    """Return kernels and those that they call, however deep."""
    known, waiting = set(), list(kernels)
    while waiting:
        kernel = waiting.pop()
        known.add(kernel)
        function = kernel._function
        called = (function.__globals__.get(name) for name in function.__code__.co_names)
        by_code = {id(other._function): other for other in called if hasattr(other, "_function")}
        waiting += [other for other in by_code.values() if other not in known]
    return known


def pytest_configure(config: pytest.Config) -> None:
    """Record where the environment names a file."""
    if path := os.environ.get("PASDEDEUX_LINES_OF_TESTS"):
        config.pluginmanager.register(Recording(Path(path)))
