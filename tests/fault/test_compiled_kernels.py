"""Kernels whose results are stored give the same bits whatever else was compiled before, and in whatever process."""

from __future__ import annotations

import os
import platform
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from tasks.shards.cluster import pinned_instructions
from tests.builders.toy_runs import ROOT

pytestmark = pytest.mark.slow

SCRIPT = """
import hashlib, sys
import numpy as np
from pasdedeux.completion.draw_index import DrawIndex
from pasdedeux.sampling.growth import ViewedImages
from pasdedeux.sampling.growth_kernels import keep_nearest, place_near_image

def residuals(rng):
    images, is_seen = rng.normal(size=(150, 2, 34)), rng.random((150, 34)) > 0.1
    images = np.where(is_seen[:, None], images, 0.0)
    return ViewedImages(images, is_seen, rng.normal(size=(150, 3))).residuals(rng.normal(size=(2, 17, 3)))

def bones(rng):
    out, parents = np.empty((2, 5, 3)), np.arange(-1, 4)
    arrays = (rng.normal(size=(2, 5, 2)), rng.normal(size=(2, 5)), rng.random((2, 5)) + 0.1)
    place_near_image(*arrays, np.arange(5), parents, rng.random((2, 5)) + 0.5, out)
    return out

def lists(rng):
    best, which = np.sort(rng.random((40, 4)), axis=1), np.tile(np.arange(4), (40, 1))
    keep_nearest(rng.random(40), 9, best, which)
    return best + which

def draws(rng):
    pairs = rng.normal(size=(300, 2, 17, 3))
    nearest = DrawIndex(pairs).nearest(rng.normal(size=(2, 17, 2)), rng.normal(size=(3, 3)), count=5)
    return np.concatenate([nearest.draw, nearest.distance_m])

parts = {part.__name__: part for part in (residuals, bones, lists, draws)}
for name in sys.argv[1:]:
    values = parts[name](np.random.default_rng(7))
    print(name, hashlib.sha256(np.ascontiguousarray(values).tobytes()).hexdigest())
"""


def run(script: str, *arguments: str, cache: Path, **environment: str) -> str:
    """Return what a script prints in a process of its own that keeps compiled kernels in a folder."""
    return subprocess.run(
        [sys.executable, "-c", script, *arguments],
        env={**os.environ, "NUMBA_CACHE_DIR": str(cache), "PYTHONPATH": str(ROOT), **environment},
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    ).stdout


def test_two_caches_that_were_filled_in_different_orders_agree(tmp_path: Path) -> None:
    names = ["residuals", "bones", "lists", "draws"]
    printed = []
    for order in (names, names[::-1]):
        cache = tmp_path / order[0]
        for _ in ("compiled", "loaded"):
            printed.append(sorted(run(SCRIPT, *order, cache=cache).splitlines()))
        assert list(cache.rglob("*.nbc"))
    assert printed[0] == printed[1] == printed[2] == printed[3]
    assert len(printed[0]) == len(names)


COUNTED = """
from numba.core import event

counter = event.RecordingListener()
event.register("numba:compile", counter)
"""
SAID = """
ended = [(event.data["dispatcher"].py_func, event.data["args"]) for _, event in counter.buffer if event.is_end]
names = [f"{kernel.__module__}.{kernel.__name__}{types}" for kernel, types in ended]
print("compiled", *(name.replace(" ", "") for name in names if name.startswith("pasdedeux")))
"""


LONG = "\n".join(f"            total += math.sin(x + {part}) * math.exp({part}.0 * step)" for part in range(20))
TWINS = f"""
import math
from pasdedeux.compiled import compiled

def adder(number):
    @compiled()
    def add(x):  # too long to be inlined
        total = 0.0
        for step in range(3):
{LONG}
        return number + 0.0 * total
    return add

add_one, add_two = adder(1.0), adder(2.0)

@compiled()
def by_one(x):
    return add_one(x) + 0.0 * add_one(x + 1.0)

@compiled()
def by_two(x):
    return add_two(x) + 0.0 * add_two(x + 1.0)
"""


def test_code_that_two_processes_compiled_is_told_apart_by_a_third(tmp_path: Path) -> None:
    """Numba numbers symbols from 1 in each process, so that the two closures would have the same one."""
    (tmp_path / "twins.py").write_text(TWINS)
    values = ["twins.by_one(0.5)", "twins.by_two(0.5)", "(twins.by_one(0.5), twins.by_two(0.5))"]
    said = [
        run(f"import twins; print({value})", cache=tmp_path / "cache", PYTHONPATH=f"{ROOT}:{tmp_path}")
        for value in values
    ]
    assert said == ["1.0\n", "2.0\n", "(1.0, 2.0)\n"]


def test_of_two_processes_one_compiles_a_kernel_and_the_other_waits_for_it(tmp_path: Path) -> None:
    command = [sys.executable, "-c", COUNTED + SCRIPT + SAID, "bones", "lists"]
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": str(ROOT)}
    both = [subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    said = [process.communicate()[0].splitlines() for process in both]
    assert said[0][:2] == said[1][:2]
    compiled = [name for lines in said for name in lines[2].split()[1:]]
    assert len(compiled) == len(set(compiled)) > 1


FULL = """
import resource, signal
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
"""


@pytest.mark.parametrize("trouble", ["no folder", "full disk"])
def test_kernels_that_cannot_be_kept_are_compiled_all_the_same(tmp_path: Path, trouble: str) -> None:
    (tmp_path / "file").touch()
    cache = tmp_path / "file" if trouble == "no folder" else tmp_path / "cache"
    script = (FULL if trouble == "full disk" else "") + SCRIPT
    said = run(script, "bones", cache=cache, NUMBA_CACHE_LOCATOR_CLASSES="UserProvidedCacheLocator")
    assert said.startswith("bones ")
    assert not list(cache.rglob("*.nbc"))


PINNED = """
from importlib.util import find_spec
import numpy as np
from numba.core import config
from numpy._core._multiarray_umath import __cpu_features__ as numpy_features
from threadpoolctl import threadpool_info

parts["product"] = lambda rng: np.exp(rng.normal(size=(70, 90)) @ rng.normal(size=(90, 50)))
print(sorted({library["architecture"] for library in threadpool_info() if library["internal_api"] == "openblas"}))
print(numpy_features["X86_V4"], config.CPU_NAME, "avx512" in config.CPU_FEATURES)
if find_spec("torch") is not None:
    import torch
    assert torch.backends.cpu.get_cpu_capability() == "AVX2"
"""


@pytest.mark.skipif(platform.machine() != "x86_64", reason="the file pins instructions of x86-64")
def test_processes_under_pinned_instructions_use_no_others_and_agree(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lines = shlex.split((ROOT / "deploy" / "instructions.env").read_text(), comments=True)
    pins = dict(line.split("=", 1) for line in lines)
    for name, value in pins.items():
        monkeypatch.setenv(name, value)
    assert pinned_instructions() == pins, "a worker that has one of them otherwise is sent away"
    script = SCRIPT.replace("for name in", f"{PINNED}\nfor name in")
    first, second = (run(script, "residuals", "product", cache=tmp_path / cache).splitlines() for cache in ("a", "b"))
    assert first[:2] == ["['Haswell']", "False haswell False"]
    assert first == second
    assert len(first) == 4
