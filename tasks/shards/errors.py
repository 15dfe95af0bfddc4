"""Errors of shards and workers."""

from __future__ import annotations

from collections.abc import Sequence

_NAMED = 5
"""Most failed shards that a message names."""


class ShardError(Exception):
    """A shard failed; the message names stage, partition and shard, then says what went wrong.

    Args:
        where: Stage, partition and shard in words.
        kind: Name of the original error's type.
        reason: The original error's message.
        trace: The original traceback as text, for `--debug`.
        others: Other shards that failed while independent ones were computed.
    """

    def __init__(
        self, where: str, kind: str, reason: str, trace: str = "", others: tuple[ShardError, ...] = ()
    ) -> None:
        super().__init__(where, kind, reason, trace, others)
        self.where = where
        self.kind = kind
        self.reason = reason
        self.trace = trace
        self.others = others

    @property
    def is_fatal(self) -> bool:
        """Whether every other shard would fail, too: the disk is full."""
        return any(error.kind == "FullDisk" for error in (self, *self.others))

    def __str__(self) -> str:
        """Return a sentence for each failed shard, of the first few."""
        sentences = [f"{error.where}: {error.reason or error.kind}" for error in (self, *self.others[: _NAMED - 1])]
        left = 1 + len(self.others) - len(sentences)
        return "; ".join(sentences + ([f"{left} more failed"] if left > 0 else []))


def join_failures(failures: Sequence[ShardError]) -> ShardError:
    """Return one error that names all failed shards; there is at least one."""
    every = [error for failure in failures for error in (failure, *failure.others)]
    first = every[0]
    return ShardError(first.where, first.kind, first.reason, first.trace, tuple(every[1:]))


class ClusterError(Exception):
    """The cluster cannot be reached or cannot work on this store; the message says why."""


class Stopped(Exception):  # noqa: N818 - not an error of its own: another one has been raised already
    """Work was given up because something else failed or the user interrupted it."""


def in_one_line(error: BaseException) -> str:
    """Return an error's message without line breaks, or its type where it says nothing."""
    return " ".join(str(error).split()) or type(error).__name__
