"""Downloads that a user asks for: limited in size, and only from public hosts if a study names the address."""

from __future__ import annotations

import re
import socket
import time
import urllib.error
import urllib.request
from http.client import HTTPException, HTTPSConnection, IncompleteRead
from ipaddress import ip_address
from typing import Any
from urllib.parse import urlsplit

from pasdedeux.errors import InputError, PasdedeuxError

_NUM_ATTEMPTS = 4
_NO_ANSWER_S = 30.0
_FIRST_WAIT_S = 0.5
_HOST = re.compile(r"([a-z0-9_]([a-z0-9_-]*[a-z0-9_])?\.)+[a-z]([a-z0-9-]*[a-z0-9])?")
_LOCAL_ENDS = (".localhost", ".local", ".localdomain", ".internal", ".intranet", ".lan", ".home", ".home.arpa", ".corp")


class FetchError(PasdedeuxError):
    """A download failed; the message names the file, its address and the reason."""


def download(url: str, *, max_bytes: int, is_public: bool = False) -> bytes:
    """Return a whole file, retrying a few times if the network fails; messages never quote the response.

    Args:
        url: Address.
        max_bytes: A larger file is refused, whether or not the site states its length.
        is_public: Allow only https to hosts on the internet, also after redirects.

    Raises:
        FetchError: It does not come, or is larger.
    """
    opener = urllib.request.build_opener(*((PublicRedirects, _PublicHandler) if is_public else ()))
    for attempt in range(_NUM_ATTEMPTS):
        try:
            with opener.open(url, timeout=_NO_ANSWER_S) as answer:
                data = bytes(answer.read(max_bytes + 1))
                if len(data) > max_bytes:
                    raise FetchError(f"{url} is larger than {max_bytes / 1e6:.0f} MB")
                if getattr(answer, "length", None):  # a read with a limit does not report that the response was cut off
                    raise IncompleteRead(data, answer.length)
                return data
        except urllib.error.HTTPError as error:
            problem = f"the site answers {error.code}"
            if error.code < 500:
                raise FetchError(f"{url}: {problem}") from None
        except HTTPException as error:
            is_cut_off = isinstance(error, IncompleteRead)
            problem = "the answer was cut off" if is_cut_off else "the answer is not that of a web server"
        except (urllib.error.URLError, ConnectionError, TimeoutError) as error:
            problem = str(getattr(error, "reason", None) or error or type(error).__name__)
        if attempt + 1 < _NUM_ATTEMPTS:
            time.sleep(_FIRST_WAIT_S * 2**attempt)
    raise FetchError(f"{url}: {problem} ({_NUM_ATTEMPTS} attempts; the same command goes on from here)")


def check_host(url: str) -> None:
    """Refuse an address that is not https to a host with a public name, such as one of this machine or network.

    Raises:
        InputError: It is no such address.

    >>> check_host("https://example.org/net.onnx")
    >>> check_host("https://127.0.0.1/net.onnx")
    Traceback (most recent call last):
    ...
    pasdedeux.errors.InputError: https://127.0.0.1/net.onnx: only https to a host with a public name is fetched from
    """
    try:
        parts = urlsplit(url)
        is_https = parts.scheme == "https" and parts.username is None and parts.port in (None, 443)
        host = (parts.hostname or "").lower()
    except ValueError:
        is_https, host = False, ""
    if not is_https or not _HOST.fullmatch(host) or f".{host}".endswith(_LOCAL_ENDS):
        raise InputError(f"{url}: only https to a host with a public name is fetched from")


def is_public_ip(ip: str) -> bool:
    """Tell whether an address of a host is on the internet."""
    address = ip_address(ip.partition("%")[0])
    mapped = getattr(address, "ipv4_mapped", None)
    return (mapped or address).is_global and not address.is_multicast


class PublicRedirects(urllib.request.HTTPRedirectHandler):
    """Follows redirects to public hosts only."""

    def redirect_request(self, req: Any, fp: Any, code: int, msg: str, headers: Any, newurl: str) -> Any:
        """Refuse a redirect to another kind of address; otherwise follow it."""
        try:
            check_host(newurl)
        except InputError:
            raise FetchError(
                f"{req.full_url}: the site leads on to a place that is not https to a public name"
            ) from None
        return super().redirect_request(req, fp, code, msg, headers, newurl)


class _PublicHandler(urllib.request.HTTPSHandler):
    """Connects to addresses on the internet only, whatever a name resolves to."""

    def https_open(self, req: Any) -> Any:
        """Open the connection, by the handler's own class."""
        return self.do_open(_PublicConnection, req)


class _PublicConnection(HTTPSConnection):
    """A connection that closes before sending anything if its peer is in a private network."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._create_connection = self._to_public

    def _to_public(self, *arguments: Any, **options: Any) -> socket.socket:
        connection = socket.create_connection(*arguments, **options)
        is_proxy = getattr(self, "_tunnel_host", None) is not None
        if not is_proxy and not is_public_ip(connection.getpeername()[0]):
            connection.close()
            raise OSError(f"{self.host} is a host of a private network")
        return connection
