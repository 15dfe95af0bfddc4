"""The panel of the viewer: adds widgets to it, and shows in it whatever goes wrong in a callback."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import nullcontext
from typing import Any

from pasdedeux.errors import PasdedeuxError
from storage_schema import StorageError


class Panel:
    """What people see and change beside the room; panes of the viewer add their widgets to it.

    Args:
        server: Server of the viewer.
        lock: Is held while something is changed.
    """

    def __init__(self, server: Any, lock: threading.RLock) -> None:
        self.server, self.gui, self._lock = server, server.gui, lock
        self.message: Any = None
        """The widget with messages; None until a pane has added it."""

    def add_message(self) -> None:
        """Add the widget with messages."""
        self.message = self.gui.add_text("message", "", multiline=True, disabled=True, visible=False)

    def tell(self, text: str) -> None:
        """Show a message of one line; the widget is there while there is one."""
        if self.message is not None:
            set_value(self.message, text)
            self.message.visible = bool(text)

    def bind(self, label: str, key: str, action: Callable[..., None]) -> None:
        """Bind a key to an action."""
        self.gui.add_command(label, hotkey=key).on_trigger(self.safely(action))

    def button(self, label: str, action: Callable[..., None], key: str = "", *, is_alone: bool = True) -> Any:
        """Add a button, which a key may press too."""
        button = self.gui.add_button(f"{label} ({key})" if key else label)
        button.on_click(self.safely(action, is_alone=is_alone))
        if key:
            self.bind(label, key, action)
        return button

    def safely(self, action: Callable[[Any], object], *, is_alone: bool = True) -> Callable[[Any], bool]:
        """Return a callback that shows any exception of an action and goes on; it tells whether there was none.

        Args:
            action: Called with the event.
            is_alone: Whether other callbacks wait until it is done.
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
        """Call a function with a value chosen in a browser; values that the program sets are passed over."""
        widget.on_update(self.safely(lambda event: change(event.target.value) if event.client is not None else None))


def set_value(widget: Any, value: Any) -> None:
    """Give a widget a value if it has another one; browsers need not hear of the same one again."""
    if widget.value != value:
        widget.value = value
