"""The panel of the viewer: its widgets by name, and callbacks that say in it what went wrong."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import nullcontext
from typing import Any

from pasdedeux.errors import PasdedeuxError
from storage_schema import StorageError


class Panel:
    """What people see and change beside the room; `put` has its widgets.

    Args:
        server: Server of the viewer.
        lock: Is held while something is changed.
    """

    def __init__(self, server: Any, lock: threading.RLock) -> None:
        self.server, self.gui, self._lock = server, server.gui, lock
        self.put: dict[str, Any] = {}

    def set(self, name: str, value: Any) -> None:
        """Give a widget a value, if it has another one: browsers need not hear of it."""
        if self.put[name].value != value:
            self.put[name].value = value

    def tell(self, text: str) -> None:
        """Say something in one line."""
        self.put["said"].value = text

    def bind(self, label: str, key: str, action: Callable[..., None]) -> None:
        """Have a key do something."""
        self.gui.add_command(label, hotkey=key).on_trigger(self.safely(action))

    def button(self, label: str, action: Callable[..., None], key: str = "", *, is_alone: bool = True) -> Any:
        """Add a button, which a key may press too."""
        button = self.gui.add_button(f"{label} ({key})" if key else label)
        button.on_click(self.safely(action, is_alone=is_alone))
        if key:
            self.bind(label, key, action)
        return button

    def safely(self, action: Callable[[Any], None], *, is_alone: bool = True) -> Callable[[Any], None]:
        """Return a callback that says what went wrong; others wait for its end where it is alone."""

        def run(event: Any) -> None:
            try:
                with self._lock if is_alone else nullcontext():
                    action(event)
            except (PasdedeuxError, StorageError, OSError, RuntimeError, TimeoutError) as error:
                self.tell(str(error) or type(error).__name__)

        return run

    def on_change(self, widget: Any, change: Callable[[Any], None]) -> None:
        """Have something done with what somebody chose in a browser; what the program sets is passed over."""
        widget.on_update(self.safely(lambda event: change(event.target.value) if event.client is not None else None))
