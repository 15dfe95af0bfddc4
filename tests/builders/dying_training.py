"""A process that trains and is killed in the middle of a step, as `kill -9` would."""

import multiprocessing
import os
import signal
from collections.abc import Sequence
from pathlib import Path

from storage_schema import Store
from tasks.stage import Shard
from tasks.training import STAGE


def train_until_killed(shards: Sequence[Shard], root: Path, step: int) -> int:
    """Run shards in a process of their own that is killed in the given step of Adam; return its exit code."""
    process = multiprocessing.get_context("spawn").Process(target=_train, args=(list(shards), root, step))
    process.start()
    process.join(timeout=120)
    assert process.exitcode is not None, "the process neither ended nor was killed"
    return process.exitcode


def _train(shards: list[Shard], root: Path, step: int) -> None:
    import torch

    done, take_step = [0], torch.optim.Adam.step

    def step_or_die(*args: object, **kwargs: object) -> object:
        done[0] += 1
        if done[0] == step:
            os.kill(os.getpid(), signal.SIGKILL)
        return take_step(*args, **kwargs)

    torch.optim.Adam.step = step_or_die  # type: ignore[method-assign,assignment]
    for shard in shards:
        STAGE.run_shard(shard, Store(root))
