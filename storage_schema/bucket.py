"""Files in S3-compatible storage: asked for again where an answer fails or is slow, written once where names are taken.

Address and credentials come from the environment alone (`AWS_ENDPOINT_URL`, `AWS_ACCESS_KEY_ID`, ...), and nothing of
them is in files or messages.
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
"""How long after a first failure a request is repeated."""
_PAUSES_S = (0.1, 8.0)
"""First and longest pause before a request is repeated; each pause is twice the one before."""
_SAY_AFTER_S, _SAY_AGAIN_S = 1.5, 15.0
_PASSING = re.compile(
    r"status code: (408|429|500|502|503|504|52\d|530)|response body|kind: (Timeout|Interrupted)"
    r"|Connection(Refused|Reset|Aborted)|TimedOut|BrokenPipe|IncompleteMessage|UnexpectedEof|(Network|Host)Unreachable"
    r"|Temporary failure in name resolution"
)
"""Marks of faults that pass: an outage, an overload, an answer that was cut off; any other is reported at once."""
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
"""Marks of faults that the user can mend, in words."""
_log = logging.getLogger(__name__)
_DELETED_AT_ONCE = 1000
"""Files in one request: more are several requests, which end in any order."""
_TIMEOUT = timedelta(seconds=60)
"""Longest time for one answer; the rest of a slower one is asked for again."""
_PIECE_BYTES = 65536
"""A file is read in pieces of this size, and those that came before an answer broke off are kept."""

S = TypeVar("S")
T = TypeVar("T")


class RemoteError(StorageError):
    """Storage elsewhere refuses or does not answer; says what was wanted, and never who asked."""


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
        """Set where nobody waits any more: what fails then is not asked for again."""
        self._saying, self._said = threading.Lock(), -_SAY_AGAIN_S

    def read(self, path: str, *, limit: int | None = None) -> bytes:
        """Return a file; FileNotFoundError without it, CorruptArtifact where it has more bytes than `limit`."""
        return b"".join(self._pieces(path, limit))

    def changed_at(self, path: str) -> datetime:
        """Return when a file was written, by the server's clock; FileNotFoundError where there is none."""
        return self._asked(f"look for {path}", lambda: self._store.head(path)["last_modified"])

    def write(self, path: str, data: bytes | Path) -> None:
        """Put a file whose name follows from its content: it does not matter who was first."""
        # Parts that are sent at the same time share the line, and each must arrive before the timeout.
        self._written(path, lambda: self._store.put(path, data, max_concurrency=1))

    def create(self, path: str, data: bytes) -> bool:
        """Put a new file; false where there is another one already, which stays.

        One with these bytes is this: an answer that was lost is asked for again.
        """

        def ask() -> bool:
            try:
                self._store.put(path, data, mode="create")
            except AlreadyExistsError as error:
                try:
                    return self.read(path) == data
                except FileNotFoundError:  # taken away since, or another request was in the way
                    raise error from None
            return True

        return self._written(path, ask)

    def read_tagged(self, path: str) -> tuple[bytes, str]:
        """Return a file and the tag of this content of it; FileNotFoundError where there is none."""

        def ask() -> tuple[bytes, str]:
            answer = self._store.get(path)
            return bytes(answer.bytes()), str(answer.meta["e_tag"])

        return self._asked(f"read {path}", ask)

    def replace(self, path: str, data: bytes, tag: str) -> str | None:
        """Put a file in the place of the one with this tag; gives the new tag, None where that is another by now.

        That other one may be this: an answer that was lost is asked for again.
        """
        try:
            put = self._asked(f"write {path}", lambda: self._store.put(path, data, mode={"e_tag": tag}))
            return str(put["e_tag"])
        except (PreconditionError, FileNotFoundError):
            return None

    def delete(self, paths: Iterable[str]) -> None:
        """Remove files, in this order by the thousand; those that are not there are as good."""
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
        """Stream a file to a new one here; gives its sha256."""
        target.unlink(missing_ok=True)
        with HashingFile(target) as file:
            for piece in self._pieces(path):
                file.write(piece)
        return file.sha256

    def at_once(self, do: Callable[[S], T], each: Iterable[S]) -> list[T]:
        """Do something with each, some at the same time; the error of the first that fails is raised.

        After an interruption no outage is waited for.
        """
        with ThreadPoolExecutor(_AT_ONCE) as pool:
            try:
                return list(pool.map(do, each))
            except KeyboardInterrupt:
                self.is_hurried.set()
                raise

    def _pieces(self, path: str, limit: int | None = None) -> Iterator[bytes]:
        """Yield a file; after an answer that breaks off, the rest of it is asked for."""
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
            except (FileNotFoundError, ValueError):  # also a name that none can have; the client's own says the address
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
        """Say that the bucket does not answer, once for all that wait, and again after some time."""
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
        # The rest of the message is the server's answer: that may name keys, as its address may, and helps nobody.
        reason = _ADDRESS.sub("the server", text.partition("<?xml")[0].partition("\n")[0].rstrip(": "))
        return RemoteError(f"{self.url}: cannot {what} ({reason}); what is there is whole, the same command goes on")


def has_md5_tag(entry: ObjectMeta, data: bytes) -> bool:
    """Tell whether a listed file is known to have these bytes: for small files the tag is nearly always their md5."""
    return hashlib.md5(data, usedforsecurity=False).hexdigest() == str(entry["e_tag"]).strip('"')
