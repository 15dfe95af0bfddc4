"""Fixtures that many tests share."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hypothesis import Phase, settings

if TYPE_CHECKING:
    from storage_schema import Store
    from tests.builders.command_line import CommandLine
    from tests.builders.real_study import BuiltStudy

# One thread for linear algebra, as workers have it; its libraries read this when numpy is first imported, by the tests.
for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")
# Each of the many processes that the tests start would compile all modules anew where the shell asks for no bytecode.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

_BUILT_ONCE = ("small", "prefect_home")
"""Fixtures that only one process is to build."""

# No example has a deadline: the first one of a kernel compiles it.  The same code draws the same examples everywhere;
# `pytest --hypothesis-profile search` draws others every time; planted faults need no simplest example.
settings.register_profile("search", deadline=None)
settings.register_profile("planted", deadline=None, derandomize=True, phases=[Phase.explicit, Phase.generate])
settings.register_profile("pasdedeux", deadline=None, derandomize=True)
settings.load_profile("pasdedeux")


def pytest_configure(config: pytest.Config) -> None:
    """Keep the order of the tests, and listen to SIGINT even where the shell that started the tests had it ignored.

    The programs that the tests start would inherit that, and the tests of Ctrl-C would wait for ever.
    """
    config.option.loadscopereorder = False  # by xdist, which puts files of many tests first
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """Run tests in one process more than there are processors: many of them wait for others' processes."""
    return (len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1) + 1


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark with `data` every test that is given the folder of real motion data, and say which tests one process runs.

    Those of a file share what it builds, and all that need what takes long to build share that.  Groups with the most
    slow tests come first: at the end, no process has much to do while the others have nothing.
    """
    groups: dict[pytest.Item, str] = {}
    for item in items:
        fixtures = getattr(item, "fixturenames", ())
        if "data_dir" in fixtures:
            item.add_marker(pytest.mark.data)
        groups[item] = next((name for name in _BUILT_ONCE if name in fixtures), item.nodeid.partition("::")[0])
        item.add_marker(pytest.mark.xdist_group(groups[item]))
    num_slow = Counter(group for item, group in groups.items() if item.get_closest_marker("slow"))
    items.sort(key=lambda item: -num_slow[groups[item]])


@pytest.fixture
def store(tmp_path: Path) -> Store:
    """Return a store that is not there yet."""
    from storage_schema import Store  # late, as all that imports numpy

    return Store(tmp_path / "store")


@pytest.fixture
def invoke(capsys: pytest.CaptureFixture[str]) -> CommandLine:
    """Return the command line, called in this process."""
    from tests.builders.command_line import CommandLine

    return CommandLine(capsys)


@pytest.fixture
def invoke_toys(capsys: pytest.CaptureFixture[str]) -> CommandLine:
    """Return the command line with the toy stages, called in this process."""
    from tests.builders.command_line import CommandLine
    from tests.builders.toys import TOYS

    return CommandLine(capsys, TOYS)


@pytest.fixture(scope="session")
def own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Unpack clips into a cache of the tests, in this process; return its folder."""
    from storage_schema import unpacked

    folder = tmp_path_factory.mktemp("cache")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(unpacked, "cache_folder", lambda: folder)
        yield folder


@pytest.fixture
def forking(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let forked children end with 0 where a flow ran in this process before: what Prefect runs at their exit fails."""
    monkeypatch.setattr(threading, "_threading_atexits", [])


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[str]]:
    """Digests of a run of the toy study that nothing happened to, one shard after the other in this process."""
    from tests.builders.toy_runs import digests, run_toys, write_study

    folder = tmp_path_factory.mktemp("undisturbed")
    run_toys(write_study(folder), folder / "store")
    return digests(folder / "store")


@pytest.fixture
def in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Build without Prefect and Dask."""
    from tests.builders.toy_runs import build_here

    build_here(monkeypatch)


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Return the folder of real motion data, named by PASDEDEUX_DATA or beside the checkout."""
    root = Path(__file__).resolve().parents[1]
    path = Path(os.environ.get("PASDEDEUX_DATA", root.parent / "shared" / "data"))
    if not (path / "cmu_salsa_bvh").is_dir():
        pytest.skip(f"real motion data is absent: no cmu_salsa_bvh in {path} (set PASDEDEUX_DATA)")
    return path


@pytest.fixture(scope="session")
def prefect_home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder in which Prefect keeps its database: one cold start of its server for all tests."""
    return tmp_path_factory.mktemp("prefect")


@pytest.fixture(scope="session")
def small(tmp_path_factory: pytest.TempPathFactory, prefect_home: Path) -> BuiltStudy:
    """Return the small study as two workers built it with one command; nothing may be computed in its store again."""
    from tests.builders.real_study import SMALL, BuiltStudy, RealRun

    folder = tmp_path_factory.mktemp("small")
    study, store = folder / "small.toml", folder / "store"
    study.write_text(SMALL)
    run = RealRun("run", study, "--store", store, "--workers", "2", "--oversubscribe", prefect_home=prefect_home)
    answer = run.finish(limit_s=900.0)  # it compiles every kernel where nobody has before
    assert answer.code == 0, answer.err
    return BuiltStudy(study, store, answer)
