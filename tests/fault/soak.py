"""A soak: the toy study is built again and again, and every few seconds something of it is killed.

    python -m tests.fault.soak --minutes 30 --every 20

Killed are, in turn, a worker, the flow, all workers, Prefect's server, and a scheduler that the run had not started.
A run that dies of it is started again by the same command.  One that finishes must have the artifacts of an undisturbed
run, and the next build starts from nothing; no artifact may be computed twice, every byte must be as its manifest says,
and no process may be left.  Ends with the figures, and with code 1 where anything was otherwise.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from contextlib import ExitStack, suppress
from pathlib import Path

import psutil

from storage_schema import Store, verify
from tests.builders.real_study import RealRun, command_of, committed, digests, wait_until_gone
from tests.builders.toy_runs import Outside, run_toys, write_study

VICTIMS = ("worker", "flow", "all workers", "Prefect's server", "scheduler")
SIZE = ("grow.num_takes=6", "grow.num_segments=4")
"""Of the study: 50 shards."""
PAUSE_S = 1.0
"""That each shard takes at least: so that what is killed is in mid-shard."""


def main() -> int:
    """Soak, and say what came of it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--every", type=float, default=20.0, help="seconds between kills")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="soak-") as folder:
        counts, problems = soak(Path(folder), 60 * options.minutes, options.every)
        left = [p.pid for p in psutil.process_iter() if p.pid != os.getpid() and folder in command_of(p)]
    if left:
        problems.append(f"processes are left: {left}")
    sys.stdout.write(json.dumps({**counts, "problems": problems}, indent=1) + "\n")
    return 1 if problems else 0


def soak(folder: Path, seconds: float, every_s: float) -> tuple[Counter[str], list[str]]:
    """Build and kill for so long; gives how often what happened, and what should not have."""
    study, store = write_study(folder), folder / "store"
    run_toys(study, folder / "undisturbed", *SIZE)
    wanted = digests(folder / "undisturbed", "toy")
    counts: Counter[str] = Counter()
    problems: list[str] = []
    made: dict[tuple[str, str, str], str] = {}
    victims = list(VICTIMS)
    elsewhere = itertools.cycle((False, False, True))
    os.environ["TOY_PAUSE_S"] = str(PAUSE_S)
    started = last_kill = time.monotonic()
    while time.monotonic() < started + seconds or made:
        with ExitStack() as held:
            is_elsewhere = next(elsewhere)
            outside = held.enter_context(Outside(folder)) if is_elsewhere else None
            run = start(study, store, folder, outside)
            while run.process.poll() is None:
                time.sleep(0.1)
                is_due = last_kill + every_s < time.monotonic() < started + seconds
                if is_due and num_artifacts(store) > len(made):
                    victim = next((victim for victim in victims if kill(run, victim, outside)), None)
                    if victim is not None:
                        last_kill = time.monotonic()
                        counts[f"killed: {victim}"] += 1
                        victims.sort(key=lambda victim: counts[f"killed: {victim}"])
                        sys.stderr.write(f"{last_kill - started:.0f} s: {victim}, {num_artifacts(store)} made\n")
            answer = run.finish()
        code, artifacts = answer.code, committed(store) if store.exists() else {}
        counts[f"runs that ended with code {code}"] += 1
        if not made.items() <= artifacts.items():
            problems.append("an artifact was computed again")
        counts["shards committed"] += len(artifacts) - len(made)
        made = artifacts
        problems += [str(problem) for problem in (verify(Store(store)).problems if made else ())]
        if code == 0:
            if digests(store, "toy") != wanted:
                problems.append("a finished build has other artifacts than an undisturbed one")
            shutil.rmtree(store)
            made = {}
        elif code not in (1, -signal.SIGKILL) or "pasdedeux --debug" in answer.err:
            problems.append(f"a run ended with code {code}: {answer.err.strip()[-500:]}")
        counts["runs that said a traceback, such as Prefect's of its server"] += "Traceback" in answer.err
        if code == 1:
            counts[answer.err.strip().splitlines()[-1]] += 1
    return counts, problems


def num_artifacts(store: Path) -> int:
    """Count them, without reading any."""
    return len(list(store.glob("*/??/*/manifest.json")))


def start(study: Path, store: Path, folder: Path, outside: Outside | None) -> RealRun:
    """Start the command that builds the study."""
    where = ("--workers", "2", "--oversubscribe") if outside is None else ("--scheduler", outside.address)
    settings = itertools.chain.from_iterable(("--set", setting) for setting in SIZE)
    return RealRun(
        *("run", study, "--store", store, *settings, *where),
        prefect_home=folder / "prefect",
        program=("-m", "tests.builders.toys"),
    )


def kill(run: RealRun, victim: str, outside: Outside | None) -> bool:
    """Kill something of a run that works; tells whether it was there."""
    with suppress(psutil.NoSuchProcess, ProcessLookupError):
        if victim == "scheduler":
            if outside is None or outside.scheduler.poll() is not None:
                return False
            outside.scheduler.kill()
            return True
        if victim == "flow":
            wait_until_gone(run.kill())
            return True
        processes = run.workers()
        if victim == "Prefect's server":
            processes = [process for process in run.descendants() if "flows.prefect_server" in command_of(process)]
        for process in processes if victim == "all workers" else processes[:1]:
            process.kill()
        return bool(processes)
    return False


if __name__ == "__main__":
    sys.exit(main())
