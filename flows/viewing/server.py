"""The server of the viewer: viser for this machine only, with a secret address and no content from other hosts.

Viser checks neither Host nor Origin of a request, and offers a tunnel through a host of its makers. This server refuses
a foreign Host or Origin before the handshake, removes the tunnel, and lets the page load nothing from other hosts
(Content-Security-Policy), such as the decoder of meshes that viser's client names. Other users of the machine can reach
its loopback, so the path of every address, for pages and sockets, begins with a token.
"""

from __future__ import annotations

import contextlib
import errno
import hmac
import io
import re
import socket
import threading
from collections.abc import Callable, Iterator
from typing import Any
from urllib.parse import parse_qs, urlsplit

from flows.viewing.side_picture import DRAG_LABEL, Pointer
from pasdedeux.errors import InputError

LOOPBACK = "127.0.0.1"
_NAMES = (LOOPBACK, "localhost")
_POLICY = (
    "default-src 'self' data: blob: 'unsafe-inline' 'unsafe-eval'; connect-src 'self' data: blob: {sockets}; "
    "frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
)


STRIP_LEFT_PX = 15
"""Distance of the timeline from the left and the lower edge of the window, by which the page finds its panel."""
_HEAD = """<title>pasdedeux</title><style>
[data-floating-window][style*="left: STRIPpx"] { width: calc(100vw - 365px) !important; }
[data-floating-window][style*="left: STRIPpx"] img { width: calc(100% - 167px); margin-left: 111px; }
</style><script>
document.documentElement.addEventListener("keydown", (event) => {
  if (event.key.startsWith("Arrow")) event.stopPropagation();
});
let held = null, isBusy = false;
const moves = [];
function isPicture(image) {
  let at = image.tagName === "IMG" ? image : null;
  while (at && !at.textContent.trim()) at = at.parentElement;
  return at !== null && at.textContent.trim().startsWith("LABEL");
}
async function tell(phase, event) {
  const box = held.getBoundingClientRect();
  if (moves.at(-1)?.startsWith("move")) moves.pop();
  const shares = [(event.clientX - box.x) / box.width, (event.clientY - box.y) / box.height];
  moves.push([phase, ...shares.map((share) => share.toFixed(5))].join("/"));
  if (isBusy) return;
  isBusy = true;
  while (moves.length) await fetch(`/TOKEN/pointer/${moves.shift()}`, {headers: {"X-Pointer": "1"}}).catch(() => {});
  isBusy = false;
}
addEventListener("pointerdown", (event) => {
  if (!isPicture(event.target)) return;
  held = event.target;
  tell("down", event);
}, true);
addEventListener("pointermove", (event) => { if (held) tell("move", event); }, true);
addEventListener("pointerup", (event) => { if (held) tell("up", event); held = null; }, true);
addEventListener("dragstart", (event) => { if (held) event.preventDefault(); }, true);
</script>""".replace("LABEL", DRAG_LABEL).replace("STRIP", str(STRIP_LEFT_PX))
"""Viser gives a panel a width in pixels; the timeline has the width of the room beside the right panel (320 px),
and the strip in it lies below the slider, between its label and its number.

Viser turns its camera with the arrow keys, listening at the document; commands listen at the element below it.

Of its pictures it tells no clicks, so the page tells the pointer over the one in which joints can be dragged.
"""
_POINTER = re.compile(r"/pointer/(down|move|up)/(-?\d+(?:\.\d+)?)/(-?\d+(?:\.\d+)?)")


def start_server(
    port: int, token: str, on_visit: Callable[[str], None], on_pointer: Callable[[Pointer], None], label: str
) -> Any:
    """Start a `viser.ViserServer` on this machine's loopback.

    Args:
        port: Port, 0 for any that is free.
        token: Secret that the path of every request begins with.
        on_visit: Called, in a separate thread, with the reference in the address of a page, `?at=REFERENCE`.
        on_pointer: Called with the actions of a pointer over the side picture; must not wait.
        label: Title of its panel.

    Raises:
        InputError: The port is in use, or viser is not installed.
    """
    try:
        import viser
        from viser._messages import ShareUrlRequest
    except ImportError:
        raise InputError("the viewer needs viser, which is not installed: pip install 'pasdedeux[view]'") from None
    _refuse_used(port)
    with _guarded(token, on_visit, on_pointer), contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host=LOOPBACK, port=port, label=label, verbose=False)
    server._websock_server.unregister_handler(ShareUrlRequest)
    return server


def _refuse_used(port: int) -> None:
    """Refuse a port that is in use; viser would silently take another one."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((LOOPBACK, port))
        except OSError as error:
            why = "is in use" if error.errno == errno.EADDRINUSE else f"cannot be used ({error.strerror})"
            raise InputError(f"port {port} {why}; --port names another one, 0 takes any that is free") from None


@contextlib.contextmanager
def _guarded(token: str, on_visit: Callable[[str], None], on_pointer: Callable[[Pointer], None]) -> Iterator[None]:
    """Add the checks to a server that is started in this block."""
    import websockets.asyncio.server as sockets

    plain, head = sockets.serve, _HEAD.replace("TOKEN", token).encode()

    def serve(*arguments: Any, process_request: Callable[..., Any], **options: Any) -> Any:
        def answer(connection: Any, request: Any) -> Any:
            host, origin = request.headers.get("Host", ""), request.headers.get("Origin")
            is_socket = request.headers.get("Upgrade", "").lower() == "websocket"
            if (why := refusal(host, origin, is_socket=is_socket)) is not None:
                return connection.respond(403, f"{why}\n")
            secret, slash, _ = request.path[1:].partition("?")[0].partition("/")
            if not hmac.compare_digest(secret.encode(), token.encode()):
                return connection.respond(403, "refused: the address lacks the token that `pasdedeux view` printed\n")
            if not slash and not is_socket:  # the page has relative links
                moved_on = connection.respond(308, "")
                moved_on.headers["Location"] = f"/{token}/{request.path[len(secret) + 1 :]}"
                return moved_on
            request.path = f"/{request.path[len(secret) + len(slash) + 1 :]}"
            # A page of another origin cannot set this header without a preflight request, which fails.
            if "X-Pointer" in request.headers and (moved := _POINTER.fullmatch(request.path)):
                on_pointer(Pointer(moved[1], float(moved[2]), float(moved[3])))  # type: ignore[arg-type]
                return connection.respond(204, "")
            if not is_socket and "Accept-Encoding" in request.headers:
                del request.headers["Accept-Encoding"]  # the page is changed below
            response = process_request(connection, request)
            if response is not None:
                response.body = response.body.replace(b"<title>Viser</title>", head, 1)
                response.headers.pop("Content-Length", None)  # missing for unknown paths
                response.headers["Content-Length"] = str(len(response.body))
                response.headers["Content-Security-Policy"] = _POLICY.format(sockets=f"ws://{host}")
                response.headers["X-Content-Type-Options"] = "nosniff"
                response.headers["Cache-Control"] = "no-store"
                response.headers["Referrer-Policy"] = "no-referrer"
                address = urlsplit(request.path)
                if address.path == "/" and (places := parse_qs(address.query).get("at")):
                    # In a thread: the holder of the viewer's lock may wait for an answer of this one.
                    threading.Thread(target=on_visit, args=(places[0],), daemon=True).start()
            return response

        return plain(*arguments, process_request=answer, **options)

    sockets.serve = serve  # type: ignore[assignment, misc]
    try:
        yield
    finally:
        sockets.serve = plain  # type: ignore[misc]


def refusal(host: str, origin: str | None, *, is_socket: bool) -> str | None:
    """Return why a request is refused, by its host and origin; None if it is not.

    >>> refusal("127.0.0.1:8080", None, is_socket=False) is None
    True
    >>> refusal("127.0.0.1:8080", "http://elsewhere.example", is_socket=True)
    'refused: a page of http://elsewhere.example may not talk to this viewer'
    """
    if host.partition(":")[0] not in _NAMES:
        return "refused: this viewer answers to 127.0.0.1 and localhost only"
    if (is_socket or origin is not None) and origin != f"http://{host}":
        return f"refused: a page of {origin or 'nowhere'} may not talk to this viewer"
    return None
