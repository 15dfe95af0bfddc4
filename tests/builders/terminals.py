"""A terminal of a given width, as much of one as progress displays use: what its user sees, line by line."""

from __future__ import annotations

import re

_PIECE = re.compile(r"\x1b\[\??([0-9;]*)([A-Za-z])|(\r)|(\n)|([^\x1b\r\n])")


class Screen:
    """Lines as a terminal of `width` columns shows them: text runs over into the next line at the edge."""

    def __init__(self, width: int) -> None:
        self.width = width
        self._cells: list[list[str]] = [[]]
        self._row = self._column = 0

    def write(self, text: str) -> int:
        """Show text with its control sequences."""
        for number, code, back, down, letter in _PIECE.findall(text):
            if letter:
                self._put(letter)
            elif back:
                self._column = 0
            elif down:
                self._down()
            elif code == "A":
                self._row = max(0, self._row - int(number or 1))
            elif code == "K":
                self._cells[self._row] = []
        return len(text)

    def flush(self) -> None:
        """Nothing is kept back."""

    def isatty(self) -> bool:
        """It is a terminal."""
        return True

    @property
    def lines(self) -> list[str]:
        """What is seen."""
        return ["".join(cells).rstrip() for cells in self._cells]

    def _put(self, letter: str) -> None:
        if self._column == self.width:
            self._down()
        cells = self._cells[self._row]
        cells += " " * (self._column + 1 - len(cells))
        cells[self._column] = letter
        self._column += 1

    def _down(self) -> None:
        self._row, self._column = self._row + 1, 0
        if self._row == len(self._cells):
            self._cells.append([])
