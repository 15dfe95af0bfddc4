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
from collections.abc import Callable, Iterable
from contextlib import suppress
from datetime import datetime, timedelta
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeVar

from obstore.exceptions import AlreadyExistsError, BaseError, PreconditionError
from obstore.store import S3Store

from storage_schema.durable import HashingFile
from storage_schema.errors import BadName, CorruptArtifact, StorageError

if TYPE_CHECKING:
    from obstore import ObjectMeta

_URL = re.compile(r"s3://(?P<bucket>[A-Za-z0-9][A-Za-z0-9.-]*)(/(?P<prefix>[^?#]*))?")
_ADDRESS = re.compile(r"https?://\S+")
AT_ONCE = 8
"""Requests in flight."""
_MAX_RETRIES = 6
_PATIENCE_S = 60.0
"""How long a bucket may refuse connections, hang up or answer with errors of its own; it is asked again meanwhile."""
_PAUSES_S = (0.5, 8.0)
"""The first pause before a bucket is asked again, and the longest: each is twice the one before."""
_SAY_AGAIN_S = 15.0
_AWAY = re.compile(r"error sending request|non-2xx status code: 5\d\d")
"""What the client says of a server that is not there, or not well."""
_log = logging.getLogger(__name__)
_DELETED_AT_ONCE = 1000
"""Files in one request: more are several requests, which end in any order."""
_TIMEOUT = timedelta(seconds=60)
"""Longest time for one answer; a slower one is asked for again."""

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
            retry_config={"max_retries": _MAX_RETRIES, "retry_timeout": 10 * timeout},
        )
        self.is_hurried = threading.Event()
        """Set where nobody waits any more: what fails then is not asked for again."""
        self._saying, self._said = threading.Lock(), -_SAY_AGAIN_S

    def read(self, path: str) -> bytes:
        """Return a file; FileNotFoundError where there is none."""
        return self._asked(f"read {path}", lambda: bytes(self._store.get(path).bytes()))

    def changed_at(self, path: str) -> datetime:
        """Return when a file was written, by the server's clock; FileNotFoundError where there is none."""
        return self._asked(f"look for {path}", lambda: self._store.head(path)["last_modified"])

    def has(self, path: str, size: int) -> bool:
        """Tell whether a file of this size is there."""
        try:
            return bool(self._asked(f"look for {path}", lambda: self._store.head(path)["size"]) == size)
        except FileNotFoundError:
            return False

    def write(self, path: str, data: bytes | Path) -> None:
        """Put a file whose name follows from its content: it does not matter who was first."""
        self._put(path, data)

    def create(self, path: str, data: bytes) -> bool:
        """Put a new file; false where there is another one already, which stays.

        One with these bytes is this: an answer that was lost is asked for again.
        """
        try:
            self._put(path, data, mode="create")
        except FileExistsError:
            with suppress(FileNotFoundError):  # taken away since
                return self.read(path) == data
            return False
        return True

    def read_tagged(self, path: str) -> tuple[bytes, str]:
        """Return a file and the tag of this content of it; FileNotFoundError where there is none."""

        def ask() -> tuple[bytes, str]:
            found = self._store.get(path)
            return bytes(found.bytes()), str(found.meta["e_tag"])

        return self._asked(f"read {path}", ask)

    def replace(self, path: str, data: bytes, tag: str) -> str | None:
        """Put a file in the place of the one with this tag; gives the new tag, None where that is another by now.

        That other one may be this: an answer that was lost is asked for again.
        """
        try:
            put = self._asked(
                f"write {path}", lambda: self._store.put(path, data, mode={"e_tag": tag}), is_conditional=True
            )
            return str(put["e_tag"])
        except (PreconditionError, FileNotFoundError):
            return None

    def delete(self, paths: Iterable[str]) -> None:
        """Remove files, in this order by the thousand; those that are not there are as good."""
        waiting = list(paths)
        for first in range(0, len(waiting), _DELETED_AT_ONCE):
            self._asked("remove files", partial(self._store.delete, waiting[first : first + _DELETED_AT_ONCE]))

    def entries(self, folder: str) -> list[ObjectMeta]:
        """Return what is in a folder and below: path, size, tag, time of the last change."""
        return self._asked(f"list {folder}", lambda: [one for part in self._store.list(f"{folder}/") for one in part])

    def names(self, folder: str) -> list[str]:
        """Return the names of the files in a folder, sorted."""
        return sorted(one["path"].rpartition("/")[2] for one in self.entries(folder))

    def fetch(self, path: str, target: Path) -> str:
        """Stream a file to a new one here; gives its sha256."""

        def stream() -> str:
            target.unlink(missing_ok=True)
            with HashingFile(target) as file:
                for chunk in self._store.get(path):
                    file.write(bytes(chunk))
            return file.sha256

        return self._asked(f"read {path}", stream)

    def read_whole(self, sha256: str) -> bytes:
        """Return the file of this digest; CorruptArtifact where its bytes have another."""
        data = self.read(f"files/{sha256}")
        if hashlib.sha256(data).hexdigest() != sha256:
            raise self.corrupt(sha256)
        return data

    def corrupt(self, sha256: str) -> CorruptArtifact:
        """Return the error of a file whose bytes have another digest."""
        return CorruptArtifact(f"{self.url}/files/{sha256} does not hold what its name says")

    def _put(self, path: str, data: bytes | Path, mode: Literal["overwrite", "create"] = "overwrite") -> None:
        try:
            is_new = mode == "create"
            self._asked(f"write {path}", lambda: self._store.put(path, data, mode=mode), is_conditional=is_new)
        except FileNotFoundError:
            raise RemoteError(f"{self.url}: cannot write {path}: there is no such bucket") from None

    def _asked(self, what: str, ask: Callable[[], T], *, is_conditional: bool = False) -> T:
        began, num_asked, pause_s = time.monotonic(), 0, _PAUSES_S[0]
        while True:
            try:
                return ask()
            except AlreadyExistsError:
                raise FileExistsError(f"{self.url}: cannot {what}: it is there") from None
            except (FileNotFoundError, ValueError):  # also a name that none can have; the client's own says the address
                raise FileNotFoundError(f"{self.url}: cannot {what}: it is not there") from None
            except PreconditionError:
                raise
            except BaseError as error:
                if "NoSuchBucket" in str(error):
                    raise RemoteError(f"{self.url}: cannot {what}: there is no such bucket") from None
                num_asked += 1
                # What the client does not ask for again: a list that was cut off, and a conditional write that was not
                # answered in time, which may have been done.
                is_lost = "response body" in str(error) or (is_conditional and "sending request" in str(error))
                left_s = _PATIENCE_S - (time.monotonic() - began) if _AWAY.search(str(error)) else 0.0
                if left_s > 0.0 and not self.is_hurried.is_set():
                    self._say_waiting(left_s)
                    self.is_hurried.wait(min(pause_s, left_s))
                    pause_s = min(2.0 * pause_s, _PAUSES_S[1])
                elif not is_lost or num_asked >= _MAX_RETRIES or self.is_hurried.is_set():
                    raise self._refused(what, error) from None

    def _say_waiting(self, left_s: float) -> None:
        """Say that the bucket does not answer, once for all that wait, and again after some time."""
        with self._saying:
            if time.monotonic() - self._said >= _SAY_AGAIN_S:
                self._said = time.monotonic()
                _log.warning("%s: the bucket does not answer, waiting up to %.0f s", self.url, left_s)

    def _refused(self, what: str, error: BaseError) -> RemoteError:
        # The rest of the message is the server's answer: that may name keys, as its address may, and helps nobody.
        reason = _ADDRESS.sub("the server", str(error).partition("<?xml")[0].partition("\n")[0].rstrip(": "))
        return RemoteError(f"{self.url}: cannot {what} ({reason}); what is there is whole, the same command goes on")
