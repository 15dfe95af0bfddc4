"""The panel of the viewer: adds widgets, and shows the errors of their callbacks."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import nullcontext
from typing import Any

from pasdedeux.errors import PasdedeuxError
from storage_schema import StorageError


class Panel:
    """The panel beside the room, to which panes add their widgets.

    Args:
        server: Server of the viewer.
        lock: Lock for changes.
    """

    def __init__(self, server: Any, lock: threading.RLock) -> None:
        self.server, self.gui, self._lock = server, server.gui, lock
        self.message: Any = None
        """The widget with messages; None until it is added."""

    def add_message(self) -> None:
        """Add the widget with messages."""
        self.message = self.gui.add_text("message", "", multiline=True, disabled=True, visible=False)

    def tell(self, text: str) -> None:
        """Show a message; without one, hide the widget."""
        if self.message is not None:
            set_value(self.message, text)
            self.message.visible = bool(text)

    def bind(self, label: str, key: str, action: Callable[..., None]) -> None:
        """Bind a key to an action."""
        self.gui.add_command(label, hotkey=key).on_trigger(self.safely(action))

    def button(self, label: str, action: Callable[..., None], key: str = "", *, is_alone: bool = True) -> Any:
        """Add a button, with an optional key."""
        button = self.gui.add_button(f"{label} ({key})" if key else label)
        button.on_click(self.safely(action, is_alone=is_alone))
        if key:
            self.bind(label, key, action)
        return button

    def safely(self, action: Callable[[Any], object], *, is_alone: bool = True) -> Callable[[Any], bool]:
        """Return a callback that shows any exception of an action, and returns whether there was none.

        Args:
            action: Called with the event.
            is_alone: Whether other callbacks wait for it.
        """

        def run(event: Any) -> bool:
            try:
                with self._lock if is_alone else nullcontext():
                    action(event)
            except Exception as error:  # noqa: BLE001 - a thread that ends would freeze the panel
                is_expected = isinstance(error, PasdedeuxError | StorageError | OSError) and str(error)
                self.tell(str(error) if is_expected else f"{type(error).__name__}: {error}".removesuffix(": "))
                return False
            return True

        return run

    def on_change(self, widget: Any, change: Callable[[Any], object]) -> None:
        """Call a function with values chosen in a browser, not with those that the program sets."""
        widget.on_update(self.safely(lambda event: change(event.target.value) if event.client is not None else None))


def set_value(widget: Any, value: Any) -> None:
    """Set the value of a widget if it differs, to send nothing needless to browsers."""
    if widget.value != value:
        widget.value = value
