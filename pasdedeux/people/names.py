"""Names of people, the same in tables, files, pages and messages."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import PurePath
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


_PERSON = re.compile(
    r"[a-f]|(s|p|person|subject|actor|performer|dancer|player|character)\d{1,2}|lead(er)?|follow(er)?|(fe)?male|(wo)?man"
)
"""A part of a file's name that identifies the person."""


def partners_of(paths: Iterable[PurePath]) -> list[tuple[PurePath, ...]]:
    """Group files of one person each into takes by their names: those of partners differ in one part only.

    That part identifies the person (`waltz_A`, `waltzB`, `push_S1`, folders `A/` and `B/`); if there is none, it is the
    one that gives the smallest groups within a folder, the first of several, as in `60_03` with `61_03`.  A file
    without a partner is a group.

    >>> [[one.name for one in take] for take in partners_of(map(PurePath, ["60_1.bvh", "61_1.bvh", "60_2.bvh"]))]
    [['60_1.bvh', '61_1.bvh'], ['60_2.bvh']]
    """
    parts = {path: _parts(path) for path in sorted(paths)}
    partners: list[list[PurePath]] = []
    for at in range(max(map(len, parts.values()), default=0)):
        for group in _differing(parts, -1 - at):
            if len(group) > 1 and all(_PERSON.fullmatch(parts[path][-1 - at]) for path in group):
                partners.append(group)
                parts = {path: words for path, words in parts.items() if path not in group}
    while parts:
        folder, length = next((path.parent, len(words)) for path, words in parts.items())
        same = {path: words for path, words in parts.items() if (path.parent, len(words)) == (folder, length)}
        ways = [_differing(same, at) for at in range(length)] or [[[path] for path in same]]
        likeliest = min(ways, key=_likelihood)
        partners += likeliest
        parts = {path: words for path, words in parts.items() if path not in same}
    return sorted(map(tuple, partners))


def take_name(files: Sequence[PurePath]) -> str:
    """Return the name of the take of some files: the name without the person, else that of the first.

    >>> take_name([PurePath("in/waltz_A.bvh"), PurePath("in/waltz_B.bvh")]), take_name([PurePath("in/60_03.bvh")])
    ('waltz', '60_03')
    """
    stem = files[0].stem
    who = re.search(r"(?<=[a-z0-9])[A-Z]$", stem) or re.search(r"[A-Za-z0-9]*$", stem)
    if len({path.stem for path in files}) < 2 or who is None or not _PERSON.fullmatch(who[0].lower()):
        return stem
    return stem[: who.start()].rstrip(" ._-") or files[0].parent.name or stem


def _parts(path: PurePath) -> tuple[str, ...]:
    """Return the parts of a path without its suffix; a capital letter at the end of a name is a part (`waltzA`)."""
    text = re.sub(r"(?<=[a-z0-9])([A-Z])(?=/|$)", r"_\1", path.with_suffix("").as_posix())
    return tuple(re.findall("[a-z0-9]+", text.lower()))


def _differing(parts: Mapping[PurePath, tuple[str, ...]], at: int) -> list[list[PurePath]]:
    """Group files whose names differ only in the part at one place."""
    groups: dict[tuple[str, ...], list[PurePath]] = {}
    for path, words in parts.items():
        place = at % len(words) if -len(words) <= at < len(words) else len(words)
        groups.setdefault((*words[:place], f"{place}", *words[place + 1 :]), []).append(path)
    return list(groups.values())


def _likelihood(groups: Sequence[Sequence[PurePath]]) -> tuple[float, int]:
    """Return a key that is smallest for likely takes: mean size of groups of several files, and number of groups."""
    sizes = [len(group) for group in groups if len(group) > 1]
    return sum(sizes) / len(sizes) if sizes else float("inf"), len(groups)
