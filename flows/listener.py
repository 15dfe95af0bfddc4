"""What a run tells while it works; the console shows it, tests and scheduled flows may ignore it."""

from __future__ import annotations

from flows.planning import StagePlan
from pasdedeux.verdict import Verdict
from tasks.shards import ShardDone

__all__ = ["Listener"]


class Listener:
    """Hears of everything that happens in a run and does nothing; a console overrides what it wants to show.

    `shard_done` comes from several threads.
    """

    def note(self, text: str) -> None:
        """Hear a sentence for the person: what is being waited for, what was found."""

    def stage_started(self, plan: StagePlan) -> None:
        """Hear that a stage is about to compute the shards that are not fresh."""

    def shard_done(self, done: ShardDone) -> None:
        """Hear that a shard is committed."""

    def stage_finished(self, plan: StagePlan, seconds: float, verdict: Verdict | None) -> None:
        """Hear that all of a stage is there, and whether it is good."""

    def close(self) -> None:
        """Hear that nothing more will come, whether the run ended well or not."""
