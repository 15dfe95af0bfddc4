"""The files of a detector: a path, or an address and digest whose file is fetched once and kept."""

from __future__ import annotations

import hashlib
import os
import re
from http.client import HTTPException
from pathlib import Path
from urllib.request import Request, urlopen

from pasdedeux.errors import InputError
from tasks.ingest.films import digest_of
from tasks.stage import SourceFile

_ADDRESS = re.compile(r"(https?://[^#\s]+)#sha256=([0-9a-f]{64})")
_TIMEOUT_S = 60.0
_MAX_BYTES = 2_000_000_000


def find_network(stated: str) -> SourceFile:
    """Return the file of a network: a path, or an address that ends in #sha256=DIGEST, fetched where it is not yet.

    Raises:
        InputError: It is not there, cannot be fetched, or has another digest.
    """
    if not re.match(r"https?://", stated):
        path = Path(stated).expanduser()
        if not path.is_file():
            raise InputError(
                f"detector {stated} does not exist; give the ONNX file of RTMO or RTMPose, or an address with "
                "#sha256=DIGEST"
            )
        return SourceFile(path=str(path), sha256=digest_of(path))
    match = _ADDRESS.fullmatch(stated)
    if match is None:
        raise InputError(
            f"detector {stated}: an address needs the digest of its file, {stated.split('#')[0]}#sha256=..."
        )
    address, digest = match.groups()
    kept = _folder() / f"{digest}.onnx"
    if not kept.is_file():
        _fetch(address, digest, kept)
    if digest_of(kept) != digest:
        raise InputError(f"detector {kept} is damaged: its digest is not {digest[:12]}...; delete it")
    return SourceFile(path=str(kept), sha256=digest)


def _folder() -> Path:
    base = os.environ.get("PASDEDEUX_CACHE")
    return (Path(base) if base else Path.home() / ".cache" / "pasdedeux") / "detectors"


def _fetch(address: str, digest: str, kept: Path) -> None:
    try:
        with urlopen(Request(address, headers={"User-Agent": "pasdedeux"}), timeout=_TIMEOUT_S) as answer:
            data = answer.read(_MAX_BYTES + 1)
    except (OSError, HTTPException, ValueError) as error:
        raise InputError(
            f"detector {address} cannot be fetched: {error}; fetch it yourself and give its path"
        ) from None
    found = hashlib.sha256(data).hexdigest()
    if found != digest:
        raise InputError(f"detector {address}: it is another file, of the digest {found[:12]}..., not {digest[:12]}...")
    kept.parent.mkdir(parents=True, exist_ok=True)
    partial = kept.with_suffix(f".{os.getpid()}")
    partial.write_bytes(data)
    partial.replace(kept)
