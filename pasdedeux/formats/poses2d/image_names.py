"""Video and frame of images and files of frames from their names: the frame is the number that varies.

A name is split into text and numbers.  Names with the same text, the template, are compared number by number: constant
numbers belong to the template, one varying number is the frame, and others identify cameras.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, takewhile

from pasdedeux.errors import FormatError
from pasdedeux.formats.text import MAX_COUNT

FramePlace = tuple[str, int]
"""Name of a video or camera, empty if there is only one, and frame."""

STILLS_STEP = 1000
"""Distance of the frame numbers of single photographs, too large for frames of a video."""
_MAX_MEDIAN_GAP = 20
"""Numbers of photographs have a larger median gap, and are not evenly spaced."""
_MIN_FRAMES = 5
"""From this number of numbered names in one template on, a name without a number is an error, not a photograph."""
_NUMBER = re.compile(r"\d{1,3}(?:[,']\d{3})+(?!\d)|\d+")
_GROUPED = re.compile(r"\d{1,3}(?:[,'_. ]\d{3})+(?!\d)|\d+")
"""Numbers with separators of thousands; points, blanks and underscores only if all names then have one template."""
_SUFFIX = re.compile(r"\.(?=[0-9]*[A-Za-z])[A-Za-z0-9]{1,5}$")
_RANDOM = re.compile(r"\.rf\.[0-9A-Za-z]+|[0-9a-f]{8}-(?:[0-9a-f]{4}-){3}[0-9a-f]{12}", re.IGNORECASE)
"""Digests of Roboflow's files, and universally unique identifiers."""
_HEX = re.compile(r"[0-9a-f]{6,}", re.IGNORECASE)
_WORD = re.compile(r"[0-9A-Za-z]+")
_CAMERA = re.compile(r"(?:cam|camera|view|kinect)[\W_]*$", re.IGNORECASE)
_FRAME = re.compile(r"(?<![A-Za-z])(?:frames?|frm|fr|f)[\W_]*$", re.IGNORECASE)
_PHOTOGRAPH = re.compile(r"(?:_?dsc[nf]?|img|pxl|p|photo|pic|picture|dcim)[\W_]*$", re.IGNORECASE)
_COLLECTED_DIGITS = 12
"""Names of photographs by cameras, and the number of digits in names of COCO's images."""
_DATE = re.compile(r"(?:19|20)\d\d(?:0[1-9]|1[0-2])(?:[0-2]\d|3[01])")


@dataclass(frozen=True)
class _Name:
    """A name, the folder that identifies its video, its texts, and the numbers between them."""

    name: str
    folder: str
    texts: tuple[str, ...]
    numbers: tuple[str, ...]

    @property
    def template(self) -> tuple[str, ...]:
        return tuple(text.lower() for text in self.texts)

    def value(self, slot: int) -> int:
        return int(re.sub(r"\D", "", self.numbers[slot]))

    def video(self, counter: int) -> tuple[str, str, str]:
        """Return the folder, and the parts of the name before and after the frame number."""
        words = [word for pair in zip(self.texts, (*self.numbers, ""), strict=True) for word in pair]
        return self.folder, "".join(words[: 2 * counter + 1]), "".join(words[2 * counter + 2 :])


def number_in_name(name: str) -> tuple[str, int | None]:
    """Split the name of a single file into the part before the frame number, and that number.

    >>> number_in_name("cam1_000000000012_keypoints.json")
    ('cam1', 12)
    >>> number_in_name("notes.json")
    ('notes.json', None)
    """
    (parsed,) = _parse({name: ""}, _NUMBER)
    if not parsed.numbers:
        return name, None
    counter = _only_slot(parsed)
    return parsed.video(counter)[1].rstrip(" _-.("), parsed.value(counter)


def places_of_names(names: Iterable[str]) -> dict[str, FramePlace]:
    """Return video and frame of each image by its name: `cam1_0012.jpg` and `cam1/0012.jpg` are frame 12 of cam1.

    Folders that all names share are ignored.  A single video has no name.  Images are single photographs if their names
    have no numbers, have dates or sparse numbers, or if most videos would have one frame.  They become frames of one
    sequence, in the order of their names, `STILLS_STEP` apart.

    Raises:
        FormatError: Two names have the same frame, or several numbers may be the frame.
    """
    parts = {name: name.replace("\\", "/").split("/")[:-1] for name in dict.fromkeys(names)}
    shared = len(list(takewhile(lambda level: len(set(level)) == 1, zip(*parts.values(), strict=False))))
    folders = {name: "/".join(folder[shared:]) for name, folder in parts.items()}
    parsed = _parse(folders, _NUMBER)
    if len({name.template for name in parsed}) > 1:
        grouped = _parse(folders, _GROUPED)
        parsed = grouped if len({name.template for name in grouped}) == 1 else parsed
    templates: dict[tuple[str, ...], list[_Name]] = {}
    for name in parsed:
        templates.setdefault(name.template, []).append(name)
    bare = next((name for name in parsed if not name.numbers), None)
    largest = max(map(len, templates.values()), default=0)
    if bare and largest >= max(_MIN_FRAMES, len(parsed) / 2) and len(templates[bare.template]) < largest:
        raise FormatError(f"'{bare.name[:60]}' has no number, but most other names have one: rename or remove it")
    if bare or any(_are_photographs(alike) for alike in templates.values()):
        return _stills(parsed)
    videos = {name.name: ("", "", "") for name in parsed}
    frames = dict.fromkeys(videos, 0)
    for alike in templates.values():
        counter, cameras = _counter(alike)
        first = alike[0].numbers
        for name in alike:
            numbers = tuple((name.numbers if slot in cameras else first)[slot] for slot in range(len(first)))
            videos[name.name], frames[name.name] = replace(name, numbers=numbers).video(counter), name.value(counter)
    if max(frames.values(), default=0) > MAX_COUNT or 2 * len(set(videos.values())) > max(2, len(frames)):
        return _stills(parsed)
    if len(set(videos.values())) == 1 and _is_sparse(parsed, sorted(frames.values())):
        return _stills(parsed)
    return _placed(videos, frames)


def _placed(videos: Mapping[str, tuple[str, str, str]], frames: Mapping[str, int]) -> dict[str, FramePlace]:
    """Return different places; text after the frame number is part of the video's name only if it differs."""
    is_alone, has_ends = len(set(videos.values())) == 1, len({after for *_, after in videos.values()}) > 1
    taken: dict[FramePlace, str] = {}
    for name, (folder, before, after) in videos.items():
        words = (before.strip(" _-.("), after.strip(" _-.)") if has_ends else "")
        video = "/".join(filter(None, (folder, "_".join(filter(None, words)))))
        place = ("" if is_alone else video, frames[name])
        if place in taken:
            raise FormatError(f"'{taken[place][:60]}' and '{name[:60]}' are both frame {place[1]} by their names")
        taken[place] = name
    return {name: place for place, name in taken.items()}


def _parse(folders: Mapping[str, str], number: re.Pattern[str]) -> list[_Name]:
    """Split names into texts and numbers, without suffixes and random words."""
    stems = {}
    for name in folders:
        base = name.replace("\\", "/").rpartition("/")[2]
        stems[name] = _RANDOM.sub("", _SUFFIX.sub("", base))
    words = [_WORD.findall(stem) for stem in stems.values()]
    columns = list(zip(*words, strict=True)) if len(set(map(len, words))) == 1 else []
    random = {place for place, column in enumerate(columns) if _is_random(column)}
    parsed = []
    for name, stem in stems.items():
        place = -1

        def plain(match: re.Match[str]) -> str:
            nonlocal place
            place += 1
            return "" if place in random else match[0]

        stem = _WORD.sub(plain, stem) if random else stem
        parsed.append(_Name(name, folders[name], tuple(number.split(stem)), tuple(number.findall(stem))))
    return parsed


def _is_random(words: Sequence[str]) -> bool:
    """Return whether words at one position of all names are digests: hexadecimal, of one length, without a template."""
    if not all(_HEX.fullmatch(word) for word in words) or len({len(word) for word in words}) > 1:
        return False
    mixed = [len(re.findall(r"\d+|\D+", word)) for word in words]
    if len(words) == 1:
        return len(words[0]) >= 8 and mixed[0] > 3
    return (
        2 * sum(parts > 2 for parts in mixed) >= len(words) and len({re.sub(r"\d+", "#", word) for word in words}) > 1
    )


def _only_slot(name: _Name) -> int:
    """Return which number of a single name is the frame: one after a word for frame, else the last except `@2x`."""
    slots = range(len(name.numbers))
    framed = [slot for slot in slots if _FRAME.search(name.texts[slot])]
    usual = [slot for slot in slots if not name.texts[slot].endswith("@")]
    return (framed or usual or [*slots])[-1]


def _counter(alike: Sequence[_Name]) -> tuple[int, list[int]]:
    """Return which number of names of one template is the frame, and which others identify cameras.

    Raises:
        FormatError: Several may be the frame.
    """
    texts, slots = alike[0].texts, range(len(alike[0].numbers))
    values = [[name.value(slot) for name in alike] for slot in slots]
    spelled = [{name.numbers[slot] for name in alike} for slot in slots]
    varying = [slot for slot in slots if len(spelled[slot]) > 1]
    if not varying:
        return _only_slot(alike[0]), []
    others = [slot for slot in slots if not _CAMERA.search(texts[slot])]
    left = [slot for slot in others if slot in varying] or others or varying
    counters = [slot for slot in left if _FRAME.search(texts[slot])] or left

    def follows(slot: int, counter: int) -> bool:
        """Return whether a number grows with a counter that differs in all names, as times do."""
        if slot not in others or len(set(values[counter])) < len(alike):
            return False
        return all(a[1] <= b[1] for a, b in pairwise(sorted(zip(values[counter], values[slot], strict=True))))

    def with_cameras(counter: int) -> tuple[int, list[int]]:
        return counter, [slot for slot in varying if slot != counter and not follows(slot, counter)]

    if len(counters) == 1:
        return with_cameras(counters[0])
    if all(
        a + 1 == b and texts[b] == "." and (not texts[a][-1:].isalpha() or _are_decimals(alike, b))
        for a, b in pairwise(counters)
    ):
        raise FormatError(f"{_shown(alike)} have times in their names, not the numbers of frames: number them")
    even = [slot for slot in counters if len(alike) > 2 and _has_steps_of_1(values[slot])]
    if len(even) == 1 and all(follows(slot, even[0]) for slot in counters):
        return with_cameras(even[0])
    are_plain = all(len(set(values[slot])) == len(spelled[slot]) < len(alike) for slot in counters[:-1])
    by_count = sorted(counters, key=lambda slot: len(spelled[slot]))
    padded = [slot for slot in counters if any(re.match("0.", number) for number in spelled[slot])]
    most = by_count[-1]
    if are_plain and (len(spelled[most]) >= 2 * len(spelled[by_count[-2]]) or padded == [most]):
        return with_cameras(most)
    raise FormatError(f"{_shown(alike)} have several numbers that may be the frame's: name them CAMERA_FRAME")


def _are_decimals(alike: Sequence[_Name], slot: int) -> bool:
    """Return whether numbers are decimals: of equal length, up to nearly the largest, in steps larger than 1."""
    values, digits = sorted({name.value(slot) for name in alike}), {len(name.numbers[slot]) for name in alike}
    steps = [later - earlier for earlier, later in pairwise(values)]
    return len(digits) == 1 and min(steps, default=0) > 1 and values[-1] + 2 * max(steps) >= 10 ** max(digits)


def _has_steps_of_1(values: Sequence[int]) -> bool:
    return len(set(values)) == len(values) == max(values) - min(values) + 1


def _shown(alike: Sequence[_Name]) -> str:
    return " and ".join(f"'{name.name[:60]}'" for name in alike[:2])


def _are_photographs(alike: Sequence[_Name]) -> bool:
    """Return whether a number of names of one template is always a date, not always the same."""
    slots = range(len(alike[0].numbers))
    return any(
        all(_DATE.fullmatch(name.numbers[slot]) for name in alike) and len({name.numbers[slot] for name in alike}) > 1
        for slot in slots
    )


def _is_sparse(parsed: Sequence[_Name], frames: Sequence[int]) -> bool:
    """Return whether names are those of cameras or COCO, with sparse and unevenly spaced numbers."""
    are_given = all(
        _PHOTOGRAPH.match(name.texts[0]) or (not any(name.texts) and len(name.numbers[0]) == _COLLECTED_DIGITS)
        for name in parsed
    )
    gaps = [later - earlier for earlier, later in pairwise(frames)]
    is_even = not gaps or (min(gaps) > 1 and not any(gap % min(gaps) for gap in gaps))
    return are_given and not is_even and sorted(gaps)[len(gaps) // 2] > _MAX_MEDIAN_GAP


def _stills(parsed: Sequence[_Name]) -> dict[str, FramePlace]:
    def natural(part: _Name) -> tuple[str, tuple[str, ...], tuple[int, ...], str]:
        return (part.folder, part.template, tuple(map(part.value, range(len(part.numbers)))), part.name)

    ranks = {name.name: rank for rank, name in enumerate(sorted(parsed, key=natural))}
    return {name.name: ("", STILLS_STEP * ranks[name.name]) for name in parsed}
