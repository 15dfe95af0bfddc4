"""Names of people, the same in tables, files, pages and messages."""

from __future__ import annotations

from string import ascii_uppercase


def person_name(index: int) -> str:
    """Return the name of the person with this index: A to Z, then AA, AB, ...

    >>> [person_name(index) for index in (0, 1, 25, 26, 27, 702)]
    ['A', 'B', 'Z', 'AA', 'AB', 'AAA']
    """
    assert index >= 0, "people are counted from 0"
    before, letter = divmod(index, len(ascii_uppercase))
    return (person_name(before - 1) if before else "") + ascii_uppercase[letter]


def person_index(name: str) -> int:
    """Return the index of the person of this name: the inverse of `person_name`.

    >>> [person_index(name) for name in ("A", "Z", "AA", "AAA")]
    [0, 25, 26, 702]
    """
    index = -1
    for letter in name:
        index = len(ascii_uppercase) * (index + 1) + ascii_uppercase.index(letter)
    return index


def person_names(count: int) -> list[str]:
    """Return the names of so many people, in their order."""
    return [person_name(index) for index in range(count)]
