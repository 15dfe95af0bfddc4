"""What can go wrong with shards and workers."""

from __future__ import annotations

__all__ = ["ClusterError", "ShardError", "Stopped", "in_one_line"]


class ShardError(Exception):
    """A shard failed; the message names stage, partition and shard, then says what went wrong.

    Args:
        where: Stage, partition and shard in words.
        kind: Name of the original error's type.
        reason: The original error's message.
        trace: The original traceback as text, for `--debug`.
    """

    def __init__(self, where: str, kind: str, reason: str, trace: str = "") -> None:
        super().__init__(where, kind, reason, trace)
        self.where = where
        self.kind = kind
        self.reason = reason
        self.trace = trace

    def __str__(self) -> str:
        """Return the one sentence a person needs."""
        return f"{self.where}: {self.reason or self.kind}"


class ClusterError(Exception):
    """The cluster cannot be reached or cannot work on this store; the message says why."""


class Stopped(Exception):  # noqa: N818 - not an error of its own: another one has been raised already
    """Work was given up because something else failed or the person interrupted."""


def in_one_line(error: BaseException) -> str:
    """Return an error's message without line breaks, or its type where it says nothing."""
    return " ".join(str(error).split()) or type(error).__name__
