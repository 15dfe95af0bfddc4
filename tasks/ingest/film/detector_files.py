"""The files of a detector: a path, or an address and digest whose file `pasdedeux fetch detector` has brought."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

from pasdedeux.errors import InputError
from storage_schema.durable import cache_folder
from tasks.downloads import check_host
from tasks.stage import SourceFile
from tasks.user_files import digest_of

_ADDRESS = re.compile(r"(https://[^#\s]+)#sha256=([0-9a-f]{64})")


class NetworkAddress(NamedTuple):
    """Where a network is on the internet, and the sha256 of its file."""

    url: str
    sha256: str

    @property
    def kept(self) -> Path:
        """Return where its file lies once it was fetched."""
        return cache_folder() / "detectors" / f"{self.sha256}.onnx"


def find_network(stated: str) -> SourceFile:
    """Return the file of a network: a path, or an address that ends in #sha256=DIGEST; nothing is sent to it.

    Raises:
        InputError: It is not there, was not fetched yet, or has another digest.
    """
    if "://" not in stated:
        path = Path(stated).expanduser()
        if not path.exists():
            raise InputError(
                f"detector {stated} does not exist; give the ONNX file of RTMO or RTMPose, or an address with "
                "#sha256=DIGEST"
            )
        return SourceFile(path=str(path), sha256=digest_of(path))
    address = network_address(stated)
    if not address.kept.exists():
        raise InputError(
            f"detector {stated} is not on this machine, and a study fetches nothing by itself; bring it with "
            f"`pasdedeux fetch detector '{stated}'`"
        )
    check_network(address)
    return SourceFile(path=str(address.kept), sha256=address.sha256)


def network_address(stated: str) -> NetworkAddress:
    """Return the parts of an address that a study may state: https, a host with a public name, a digest.

    Raises:
        InputError: It is another one.
    """
    match = _ADDRESS.fullmatch(stated)
    if match is None:
        raise InputError(
            f"detector {stated}: an address is https://HOST/FILE#sha256=DIGEST with the 64 digits of its file's digest"
        )
    check_host(match[1])
    return NetworkAddress(match[1], match[2])


def check_network(address: NetworkAddress) -> None:
    """Refuse a kept file whose content has changed.

    Raises:
        InputError: Its digest is not that of its name.
    """
    if digest_of(address.kept) != address.sha256:
        raise InputError(f"detector {address.kept} is damaged: it has another digest than its name; delete it")
