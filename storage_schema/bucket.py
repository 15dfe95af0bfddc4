"""Files in S3-compatible storage: failed or slow requests are repeated, and existing names are not overwritten.

Address and credentials come only from the environment (`AWS_ENDPOINT_URL`, `AWS_ACCESS_KEY_ID`, ...), and never appear
in files or messages.
"""

from __future__ import annotations

import hashlib
import logging
import re
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import datetime, timedelta
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from obstore.exceptions import AlreadyExistsError, BaseError, PreconditionError
from obstore.store import S3Store

from storage_schema.durable import HashingFile
from storage_schema.errors import BadName, CorruptArtifact, StorageError

if TYPE_CHECKING:
    from obstore import ObjectMeta

_URL = re.compile(r"s3://(?P<bucket>[A-Za-z0-9][A-Za-z0-9.-]*)(/(?P<prefix>[^?#]*))?")
_ADDRESS = re.compile(r"https?://\S+")
_AT_ONCE = 8
"""Requests in flight."""
_PATIENCE_S = 60.0
"""Time during which a failed request is repeated."""
_PAUSES_S = (0.1, 8.0)
"""First and longest pause before a request is repeated; pauses double."""
_SAY_AFTER_S, _SAY_AGAIN_S = 1.5, 15.0
_PASSING = re.compile(
    r"status code: (408|429|500|502|503|504|52\d|530)|response body|kind: (Timeout|Interrupted)"
    r"|Connection(Refused|Reset|Aborted)|TimedOut|BrokenPipe|IncompleteMessage|UnexpectedEof|(Network|Host)Unreachable"
    r"|Temporary failure in name resolution"
)
"""Marks of temporary faults: outage, overload, interrupted answer. Other faults are reported at once."""
_CAUSES = {
    "dns error": "the server's host name cannot be resolved, check AWS_ENDPOINT_URL",
    "InvalidContentType": "the server does not speak https, check AWS_ENDPOINT_URL",
    "Parse(": "the server does not speak http, check AWS_ENDPOINT_URL",
    "ertificate": "the server's certificate is not trusted",
    "RequestTimeTooSkewed": "the clock of this machine or of the server is wrong",
    "SignatureDoesNotMatch": "the server refuses the signature, check AWS_SECRET_ACCESS_KEY",
    "InvalidAccessKeyId": "the server does not know the key, check AWS_ACCESS_KEY_ID",
    "status code: 401": "the server wants credentials, set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY",
    "status code: 403": "access is denied, check the credentials in the environment and the rights of their owner",
}
"""Marks of faults that the user can correct, with advice."""
_log = logging.getLogger(__name__)
_DELETED_AT_ONCE = 1000
"""Largest number of files in one request."""
_TIMEOUT = timedelta(seconds=60)
"""Longest time for one answer; the rest of a slower one is requested again."""
_PIECE_BYTES = 65536
"""Size of the pieces in which a file is read; pieces before an interruption are kept."""

S = TypeVar("S")
T = TypeVar("T")


class RemoteError(StorageError):
    """Remote storage refuses or does not answer; the message names the request, never credentials."""


class RemoteStore:
    """Files in a bucket, below a prefix.

    The address is `s3://bucket/prefix`, `timeout` the longest time for one answer.

    Raises:
        BadName: The address has another form.
    """

    def __init__(self, url: str, *, timeout: timedelta = _TIMEOUT) -> None:
        match = _URL.fullmatch(url.rstrip("/"))
        if match is None:
            raise BadName(
                f"'{url}' is no place in storage: s3://BUCKET/PREFIX is meant, credentials in the environment"
            )
        self.url = url.rstrip("/")
        self._store = S3Store(
            match["bucket"],
            prefix=match["prefix"] or None,
            client_options={
                "allow_http": True,
                "timeout": timeout,
                "connect_timeout": min(timeout, timedelta(seconds=10)),
            },
            retry_config={"max_retries": 0, "retry_timeout": timeout},
        )
        self.is_hurried = threading.Event()
        """Set when nobody waits any more: failed requests are not repeated."""
        self._saying, self._said = threading.Lock(), -_SAY_AGAIN_S

    def read(self, path: str, *, limit: int | None = None) -> bytes:
        """Return a file; FileNotFoundError without it, CorruptArtifact if it has more bytes than `limit`."""
        return b"".join(self._pieces(path, limit))

    def changed_at(self, path: str) -> datetime:
        """Return when a file was written, by the server's clock; FileNotFoundError without it."""
        return self._asked(f"look for {path}", lambda: self._store.head(path)["last_modified"])

    def write(self, path: str, data: bytes | Path) -> None:
        """Write a file whose name follows from its content, so that an overwrite is harmless."""
        # Concurrent parts share the bandwidth, and each must arrive before the timeout.
        self._written(path, lambda: self._store.put(path, data, max_concurrency=1))

    def create(self, path: str, data: bytes) -> bool:
        """Create a file; return false if there is another one, which stays.

        A file with the same bytes counts as created, because a request whose answer was lost is repeated.
        """

        def ask() -> bool:
            try:
                self._store.put(path, data, mode="create")
            except AlreadyExistsError as error:
                try:
                    return self.read(path) == data
                except FileNotFoundError:  # removed since, or in conflict with another request
                    raise error from None
            return True

        return self._written(path, ask)

    def read_tagged(self, path: str) -> tuple[bytes, str]:
        """Return a file and its tag; FileNotFoundError without it."""

        def ask() -> tuple[bytes, str]:
            answer = self._store.get(path)
            return bytes(answer.bytes()), str(answer.meta["e_tag"])

        return self._asked(f"read {path}", ask)

    def replace(self, path: str, data: bytes, tag: str) -> str | None:
        """Replace the file if it has this tag; return the new tag, None if the file has changed.

        The new content may be this one, because a request whose answer was lost is repeated.
        """
        try:
            put = self._asked(f"write {path}", lambda: self._store.put(path, data, mode={"e_tag": tag}))
            return str(put["e_tag"])
        except (PreconditionError, FileNotFoundError):
            return None

    def delete(self, paths: Iterable[str]) -> None:
        """Remove files, in this order by the thousand; missing ones are ignored."""
        waiting = list(paths)
        for first in range(0, len(waiting), _DELETED_AT_ONCE):
            self._asked("remove files", partial(self._store.delete, waiting[first : first + _DELETED_AT_ONCE]))

    def entries(self, folder: str) -> list[ObjectMeta]:
        """List a folder and its subfolders: path, size, tag, time of the last change."""
        return self._asked(
            f"list {folder}", lambda: [entry for part in self._store.list(f"{folder}/") for entry in part]
        )

    def names(self, folder: str) -> list[str]:
        """Return the names of the files in a folder, sorted."""
        return sorted(entry["path"].rpartition("/")[2] for entry in self.entries(folder))

    def fetch(self, path: str, target: Path) -> str:
        """Download a file, and return its sha256."""
        target.unlink(missing_ok=True)
        with HashingFile(target) as file:
            for piece in self._pieces(path):
                file.write(piece)
        return file.sha256

    def at_once(self, do: Callable[[S], T], each: Iterable[S]) -> list[T]:
        """Apply a function to each item, some at the same time; raise the error of the first that fails.

        After an interruption, outages are not waited for.
        """
        with ThreadPoolExecutor(_AT_ONCE) as pool:
            try:
                return list(pool.map(do, each))
            except KeyboardInterrupt:
                self.is_hurried.set()
                raise

    def _pieces(self, path: str, limit: int | None = None) -> Iterator[bytes]:
        """Yield a file in pieces; after an interruption, request the rest."""
        num_bytes, tag = 0, None
        stream: Iterator[bytes] | None = None

        def ask() -> bytes | None:
            nonlocal tag, stream
            if stream is None:
                answer = self._store.get(path, options={"range": {"offset": num_bytes}} if num_bytes else None)
                if limit is not None and answer.meta["size"] > limit:
                    raise CorruptArtifact(f"{self.url}/{path} is larger than {limit / 1e6:.0f} MB")
                if num_bytes and answer.meta["e_tag"] != tag:
                    raise RemoteError(f"{self.url}: cannot read {path}: it was replaced meanwhile; try again")
                tag, stream = answer.meta["e_tag"], map(bytes, answer.stream(min_chunk_size=_PIECE_BYTES))
            try:
                return next(stream, None)
            except BaseError:
                stream = None
                raise

        while (piece := self._asked(f"read {path}", ask)) is not None:
            num_bytes += len(piece)
            yield piece

    def _written(self, path: str, put: Callable[[], T]) -> T:
        try:
            return self._asked(f"write {path}", put)
        except FileNotFoundError:
            raise RemoteError(f"{self.url}: cannot write {path}: there is no such bucket") from None

    def _asked(self, what: str, ask: Callable[[], T]) -> T:
        began, failed_at, pause_s = time.monotonic(), None, _PAUSES_S[0]
        while True:
            try:
                return ask()
            except (FileNotFoundError, ValueError):  # also an impossible name; the client's message has the address
                raise FileNotFoundError(f"{self.url}: cannot {what}: it is not there") from None
            except PreconditionError:
                raise
            except BaseError as error:
                now = time.monotonic()
                failed_at = failed_at or now
                left_s = _PATIENCE_S - (now - failed_at)
                is_passing = isinstance(error, AlreadyExistsError) or _PASSING.search(str(error))
                if left_s <= 0.0 or self.is_hurried.is_set() or not is_passing:
                    raise self._refused(what, error) from None
                if now - began > _SAY_AFTER_S:
                    self._say_waiting(left_s)
                self.is_hurried.wait(min(pause_s, left_s))
                pause_s = min(2.0 * pause_s, _PAUSES_S[1])

    def _say_waiting(self, left_s: float) -> None:
        """Log that the bucket does not answer, once for all waiting threads, and again after some time."""
        with self._saying:
            if time.monotonic() - self._said >= _SAY_AGAIN_S:
                self._said = time.monotonic()
                _log.warning("%s: the bucket does not answer, waiting up to %.0f s", self.url, left_s)

    def _refused(self, what: str, error: BaseError) -> RemoteError:
        text = str(error)
        if "NoSuchBucket" in text:
            return RemoteError(f"{self.url}: cannot {what}: there is no such bucket")
        if cause := next((words for mark, words in _CAUSES.items() if mark in text), ""):
            return RemoteError(f"{self.url}: cannot {what}: {cause}")
        # The rest of the message is the server's answer, which may contain keys, as its address may.
        reason = _ADDRESS.sub("the server", text.partition("<?xml")[0].partition("\n")[0].rstrip(": "))
        return RemoteError(f"{self.url}: cannot {what} ({reason}); what is there is whole, the same command goes on")


def has_md5_tag(entry: ObjectMeta, data: bytes) -> bool:
    """Return whether a listed file is known to have these bytes; the tag of small files is nearly always their md5."""
    return hashlib.md5(data, usedforsecurity=False).hexdigest() == str(entry["e_tag"]).strip('"')
