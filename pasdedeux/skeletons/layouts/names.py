"""Normal forms of joint names, without namespace, prefix, case and separators, and with one form of the side."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache

SIDES = ("left", "right")
_SIDE_WORDS = {"left": "left", "lft": "left", "right": "right", "rght": "right", "rgt": "right"}
_SIDE_WORDS |= {"左": "left", "右": "right"}
_SIDE_LETTERS = {"l": "left", "r": "right"}
_NOISE = {"jnt", "joint", "jt", "bone", "bn", "bind", "skel", "def", "org", "drv", "c"}
"""Words that rigs put before or after names; `c` means the middle."""
_COMMON = 0.6
"""Minimum share of the names that have a prefix or suffix; the names of one side are fewer."""
_PREFIX, _MANY = 4, 10
"""Minimum length of a common prefix of all names; with more names than this, one letter is enough."""
_NUMBERED = 0.9
"""Minimum share of numbered names for the numbers to be left out."""

Words = tuple[str, ...]


def normal_names(joint_names: Sequence[str]) -> list[str]:
    """Return the names in the form in which layouts compare them: lower case, with `left.` or `right.` in front.

    A namespace (`mixamorig12:`), a prefix or suffix of most names (`Character1_`, `Bip01 `), the suffixes of copies
    (`.001`, `#`), words such as `jnt`, separators and leading zeros are removed, unless names would become equal.  A
    single `l` or `r` is a side if its counterpart is among the names.

    >>> normal_names(["Bip01 Pelvis", "Bip01 L Thigh", "Bip01 R Thigh", "Bip01 Spine1"])
    ['pelvis', 'left.thigh', 'right.thigh', 'spine1']
    """
    return list(_normal_names(tuple(joint_names)))


@lru_cache(maxsize=256)
def _normal_names(joint_names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the same as tuples; cached, because thousands of files may have the same joints."""
    copies = [re.sub(r"(\.\d+|#\d*)+$", "", name) for name in joint_names]
    repeated = Counter(copies)
    kept = [copy if repeated[copy] == 1 else name for copy, name in zip(copies, joint_names, strict=True)]
    bare = [next((part for part in reversed(re.split(r"[:|]", name)) if not part.isdigit()), name) for name in kept]
    lower = sorted(name.lower() for name in bare)
    shared = next((at for at, (a, b) in enumerate(zip(lower[0], lower[-1], strict=False)) if a != b), 0)
    words = [_words(name[shared if shared >= _PREFIX or len(bare) > _MANY else 0 :]) for name in bare]
    words = _without_common(_without_common(words, 0), -1)
    known = {tuple(row) for row in words}
    normal = [_normal(row, known) for row in words]
    repeated = Counter(normal)
    return tuple(
        name if repeated[name] == 1 else _normal(row, known, keeps=True)
        for name, row in zip(normal, words, strict=True)
    )


def by_normal_name(joint_names: Sequence[str]) -> Mapping[str, str]:
    """Return the joint of each normal name; the first if several have the same."""
    return dict(reversed(list(zip(normal_names(joint_names), joint_names, strict=True))))


def with_sides_exchanged(joint_names: Sequence[str]) -> list[str]:
    """Exchange left and right in the names; other names stay.

    >>> with_sides_exchanged(["Hips", "LeftLeg", "RightLeg", "LeftLeg_end"])
    ['Hips', 'RightLeg', 'LeftLeg', 'LeftLeg_end']
    """
    normal = normal_names(joint_names)
    joints, other = dict(zip(normal, joint_names, strict=True)), dict(zip(SIDES, reversed(SIDES), strict=True))
    parts = [name.partition(".") for name in normal]
    return [
        joints.get(f"{other.get(side)}.{part}", name) for (side, _, part), name in zip(parts, joint_names, strict=True)
    ]


def _words(name: str) -> Words:
    words = re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+|[^\W\d_a-zA-Z]+", name)
    return tuple(str(int(word)) if word.isdigit() else word.lower() for word in words)


def _without_common(names: list[Words], at: int) -> list[Words]:
    """Remove the first (0) or last (-1) word while most names have the same word or a number there."""
    while True:
        several = [name for name in names if len(name) > 1]
        ends = Counter("0" if name[at].isdigit() else name[at] for name in several)
        word, count = ends.most_common(1)[0] if ends else ("", 0)
        share = _NUMBERED if word == "0" else _COMMON
        if count < max(share * len(names), 3) or word in _SIDE_WORDS or word in _SIDE_LETTERS:
            return names
        names = [
            (name[1:] if at == 0 else name[:-1])
            if len(name) > 1 and (name[at] == word or (word == "0" and name[at].isdigit()))
            else name
            for name in names
        ]


def _normal(words: Words, known: set[Words], *, keeps: bool = False) -> str:
    """Return the normal name of these words; it keeps noise words if it would be empty, or if `keeps`."""
    side, rest = _side(words, known)
    if not keeps:
        rest = tuple(word for word in rest if word not in _NOISE) or rest
    return f"{side}." * bool(side) + "".join(rest)


def _side(words: Words, known: set[Words]) -> tuple[str, Words]:
    """Return the side in a name, and its other words."""
    for at, word in enumerate(words):
        if word in _SIDE_WORDS and len(words) > 1:
            return _SIDE_WORDS[word], words[:at] + words[at + 1 :]
    for at, word in enumerate(words):
        if word in _SIDE_LETTERS and (*words[:at], "r" if word == "l" else "l", *words[at + 1 :]) in known:
            return _SIDE_LETTERS[word], words[:at] + words[at + 1 :]
    for at in (0, len(words) - 1) if words else ():
        for bare, side, other in _letters(words[at]):
            there = {(*words[:at], form, *words[at + 1 :]) for form in other}
            if there & known:
                return side, (*words[:at], bare, *words[at + 1 :])
    return "", words


def _letters(word: str) -> Iterator[tuple[str, str, tuple[str, ...]]]:
    """Yield a word without a side at its start or end, the side, and possible words of the other side."""
    for marks in (_SIDE_WORDS, _SIDE_LETTERS):
        for mark, side in marks.items():
            others = [other for other, its_side in marks.items() if its_side != side]
            if word.startswith(mark) and len(word) > len(mark):
                bare = word.removeprefix(mark)
                yield bare, side, tuple(other + bare for other in others)
            if marks is _SIDE_WORDS and word.endswith(mark) and len(word) > len(mark):
                bare = word.removesuffix(mark)
                yield bare, side, tuple(bare + other for other in others)
