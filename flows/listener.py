"""What a run tells while it works; the console shows it, tests and scheduled flows may ignore it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from flows.planning import StagePlan
from pasdedeux.verdict import Verdict
from tasks.shards import ShardDone
from tasks.stage import Shard


@dataclass(frozen=True)
class Progress:
    """How far a run is.

    Args:
        num_done: Shards that have ended.
        num_shards: Shards that are known to be needed, those of stages that cannot be planned yet as many as last time.
        running: Shards handed to workers.
        left_s: Seconds to the end where shards take what those of their stage take, or took last time.
        is_all: Whether that is all; else there are stages of which nothing is known.
    """

    num_done: int
    num_shards: int
    running: Sequence[Shard]
    left_s: float
    is_all: bool


class Listener:
    """Is called with everything that happens in a run and does nothing; a console overrides what it wants to show.

    Shards of a stage may be done before it is said to start: what they read was there before all that the stage reads.
    """

    def note(self, text: str) -> None:
        """Take a message for the person: what is being waited for, what was found."""

    def stage_started(self, plan: StagePlan) -> None:
        """A stage is about to compute the shards that are not fresh."""

    def shard_done(self, done: ShardDone) -> None:
        """A shard is committed."""

    def progressed(self, progress: Progress) -> None:
        """Shards have started or ended."""

    def stage_finished(self, plan: StagePlan, seconds: float, verdict: Verdict | None) -> None:
        """All of a stage is there; the verdict says whether it is good."""

    def close(self) -> None:
        """Nothing more will come, whether the run ended well or not."""
