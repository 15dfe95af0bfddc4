"""The lease of a store in a bucket, which allows one build at a time: a file that its holder renews.

A lease is renewed while its holder is alive. No clocks are compared: a process takes the lease if it has watched
it unchanged for `LEASE_S`, or if its holder was of this machine and is dead, and only if the lease is still as it was
read.
"""

from __future__ import annotations

import json
import logging
import os
import platform
import threading
import time
import uuid
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

from storage_schema.bucket import RemoteError, RemoteStore
from storage_schema.errors import StorageError

LEASE_S = 60.0
"""Time without renewal after which a lease is free."""
_BEAT_S = 4.0
_WATCH_S = 0.5
_SAY_AFTER_S = 4.5
"""Time without renewal after which this is logged; a live holder renews earlier."""
_log = logging.getLogger(__name__)


class Lease:
    """The right of this process to build in a store, once it is taken."""

    def __init__(self, remote: RemoteStore) -> None:
        self._remote = remote
        self._name, self._tag, self._count = uuid.uuid4().hex, "", 0
        self._lock = threading.Lock()
        self.is_over = False
        """Whether it was released, or lost to another run."""

    def take(self) -> None:
        """Take the lease, or wait to find out whether its holder is alive.

        Raises:
            StorageError: Another run has it.
            RemoteError: The bucket refuses or does not answer.
        """
        first_tag, since, is_said = "", time.monotonic(), False
        while True:
            try:
                there, tag = self._remote.read_tagged("lease")
            except FileNotFoundError:
                self._remote.create("lease", self._as_bytes())
                continue
            lease = _parsed(there)
            if lease["holder"] == self._name:
                self._tag = tag
                return
            is_unchanged = tag == first_tag and time.monotonic() - since > LEASE_S
            if not lease["holder"] or is_unchanged or _is_dead_here(lease):
                self._remote.replace("lease", self._as_bytes(), tag)
                continue
            if first_tag not in ("", tag):
                raise StorageError(
                    f"a run plans or builds in the store {self._remote.url} "
                    f"(process {lease['pid']} on {lease['host']}); try again when it has ended"
                )
            if not first_tag:
                first_tag, since = tag, time.monotonic()
            if not is_said and time.monotonic() - since > _SAY_AFTER_S:
                is_said = True
                until = time.strftime("%H:%M:%S", time.localtime(time.time() + LEASE_S - (time.monotonic() - since)))
                _log.warning(
                    "%s: process %s on %s has the lease and does not renew it; waiting until %s, then this run takes "
                    "it over",
                    *(self._remote.url, lease["pid"], lease["host"], until),
                )
            time.sleep(_WATCH_S)

    def renew(self, *, released: bool = False) -> bool:
        """Renew or release the lease; return whether it was still held."""
        with self._lock:
            for _ in range(2):
                if self.is_over:
                    break
                self._count += 1
                tag = self._remote.replace("lease", self._as_bytes(released=released), self._tag)
                if tag is not None:
                    self._tag, self.is_over = tag, released
                    return True
                try:
                    there, self._tag = self._remote.read_tagged("lease")
                    self.is_over = _parsed(there)["holder"] != self._name
                except FileNotFoundError:
                    self.is_over = True
            return False

    def check(self) -> None:
        """Renew the lease.

        Raises:
            StorageError: The lease was lost.
        """
        if not self.renew():
            raise self.lost()

    def lost(self) -> StorageError:
        """Return the error for a lost lease."""
        return StorageError(
            f"another run has taken over the store {self._remote.url}, as the lease of this one was not renewed for "
            f"{LEASE_S:g} s; what was committed is whole, the same command goes on"
        )

    def _as_bytes(self, *, released: bool = False) -> bytes:
        values = {"holder": "" if released else self._name, "host": platform.node(), "pid": os.getpid()}
        return json.dumps({**values, "system": _system(), "renewed": self._count}).encode()


def each_beat(do: Callable[[], object], ended: threading.Event) -> None:
    """Call a function at intervals until the block ends; if the bucket does not answer, try again next time."""
    while not ended.wait(_BEAT_S):
        with suppress(RemoteError, FileNotFoundError):
            do()


def _parsed(lease: bytes) -> dict[str, Any]:
    """Return the content of a lease; an unreadable one counts as held, and expires if it does not change."""
    parsed = {"holder": "unknown", "host": "an unknown machine", "pid": "unknown", "system": ""}
    with suppress(ValueError, TypeError):
        parsed |= json.loads(lease)
    # Anyone with write access to the bucket may have written them, and they are printed.
    return parsed | {name: json.dumps(str(parsed[name]))[1:-1] for name in ("host", "pid")}


def _is_dead_here(parsed: dict[str, Any]) -> bool:
    """Return whether a lease's process belonged to this system and has ended."""
    return parsed["system"] == _system() != "" and not Path(f"/proc/{parsed['pid']}").exists()


@cache
def _system() -> str:
    """Return an id of this system's process numbers, which differ between containers of one host name."""
    try:
        return f"{Path('/proc/sys/kernel/random/boot_id').read_text().strip()} {Path('/proc/self/ns/pid').readlink()}"
    except OSError:
        return ""
