"""What a run tells while it works; the console shows it, tests and scheduled flows may ignore it."""

from __future__ import annotations

from flows.planning import StagePlan
from pasdedeux.verdict import Verdict
from tasks.shards import ShardDone

__all__ = ["Listener"]


class Listener:
    """Is called with everything that happens in a run and does nothing; a console overrides what it wants to show.

    `shard_done` comes from several threads.
    """

    def note(self, text: str) -> None:
        """Take a message for the person: what is being waited for, what was found."""

    def stage_started(self, plan: StagePlan) -> None:
        """A stage is about to compute the shards that are not fresh."""

    def shard_done(self, done: ShardDone) -> None:
        """A shard is committed."""

    def stage_finished(self, plan: StagePlan, seconds: float, verdict: Verdict | None) -> None:
        """All of a stage is there; the verdict says whether it is good."""

    def close(self) -> None:
        """Nothing more will come, whether the run ended well or not."""
