"""Recognition of joint names in any spelling, and the keypoints of a layout that they mean."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from functools import lru_cache

_SIDED = {
    "shoulder": "shoulder sho shldr shoul",
    "elbow": "elbow elb elbo",
    "wrist": "wrist wri wrst hand",
    "hip": "hip",
    "knee": "knee kne",
    "ankle": "ankle ank ankl foot",
    "eye": "eye",
    "ear": "ear",
    "eye_inner": "eyeinner innereye",
    "eye_outer": "eyeouter outereye",
    "big_toe": "bigtoe footindex toetip toe toebase toes",
    "small_toe": "smalltoe littletoe",
    "heel": "heel",
    "pinky": "pinky",
    "index": "index",
    "thumb": "thumb",
    "mouth": "mouth",
}
_PELVIS = "midhip pelvis root hipcenter centerhip hipscenter midhips hips hip"
_MIDDLE = {
    "nose": "nose nosetip",
    "neck": "thorax neck midshoulder shouldercenter",
    "upper_neck": "upperneck headbottom bottomhead",
    "head_top": "headtop tophead topofhead crown",
    "head": "head face",
    "mid_hip": _PELVIS,
    "pelvis": _PELVIS,
    "belly": "belly torso stomach abdomen spine",
    "spine": "spine",
    "chest": "chest",
}
_SIDES = {"left": "left", "right": "right", "l": "left", "r": "right"}
_PARTS = {word for words in _SIDED.values() for word in words.split()}
_CAMEL = re.compile(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])")
_EMPTY_WORDS = frozenset({"", "landmark", "joint", "keypoint", "kpt", "kp", "body", "the", "of"})


@lru_cache(maxsize=4096)
def plain_name(name: str) -> tuple[str, str]:
    """Return side (`left`, `right` or empty) and part of a joint's name, in lower case without separators.

    >>> plain_name("LShoulder"), plain_name("shoulder.L"), plain_name("R_Sho"), plain_name("Mid Hip")
    (('left', 'shoulder'), ('left', 'shoulder'), ('right', 'sho'), ('', 'midhip'))
    """
    words = [word for word in re.split(r"[\W_]+", _CAMEL.sub("_", name).lower()) if word not in _EMPTY_WORDS]
    words = words[1:] if len(words) > 1 and words[0].isdigit() else words
    at = next((at for at, word in enumerate(words) if word in _SIDES and len(words) > 1), None)
    if at is not None:
        return _SIDES[words[at]], "".join(words[:at] + words[at + 1 :])
    whole = "".join(words)
    for word, side in _SIDES.items():
        for part in (whole.removeprefix(word), whole.removesuffix(word)):
            if part != whole and part in _PARTS:
                return side, part
    return "", whole


@lru_cache(maxsize=1024)
def _accepted(keypoint: str) -> list[tuple[str, str]]:
    """Return possible names of a keypoint as side and part, best first."""
    side, part = keypoint.partition("_")[::2]
    if keypoint in ("mouth_left", "mouth_right"):
        side, part = part, side
    if side in ("left", "right") and part in _SIDED:
        return [(side, word) for word in _SIDED[part].split()]
    return [("", word) for word in _MIDDLE.get(keypoint, "").split()] or [plain_name(keypoint)]


def is_joint(name: str) -> bool:
    """Return whether a name is the name of a keypoint.

    >>> is_joint("l-shoulder"), is_joint("hat")
    (True, False)
    """
    side, part = plain_name(name)
    return part in _PARTS if side else any(part in words.split() for words in _MIDDLE.values())


def find_keypoints(
    keypoints: Sequence[str], names: Sequence[str], also: Mapping[str, Sequence[str]]
) -> list[int | None]:
    """Return for each keypoint the index of its name; None if it has none.

    If all names are in the order of the layout, this order is kept.  Else identical spellings come first, then names of
    the same meaning, then names in the data set of the layout.

    Args:
        keypoints: Keypoints of a layout in order.
        names: Names of joints, in any order.
        also: Other names of keypoints, in the data set of the layout.
    """
    plain = [plain_name(name) for name in names]
    others = {keypoint: [plain_name(word) for word in words] for keypoint, words in also.items()}
    accepted = {keypoint: [*_accepted(keypoint), *others.get(keypoint, ())] for keypoint in keypoints}
    pairs = list(zip(keypoints, plain, strict=False))
    if len(names) == len(keypoints) and all(name in accepted[keypoint] for keypoint, name in pairs):
        return list(range(len(names)))
    if {"nose", "head_top"} <= accepted.keys() and ("", "nose") in plain:
        accepted["head_top"].append(("", "head"))
    places: dict[str, int] = {keypoint: names.index(keypoint) for keypoint in keypoints if keypoint in names}
    for words in (_accepted, accepted.__getitem__):
        for keypoint in keypoints:
            taken = set(places.values())
            free = (at for word in words(keypoint) for at, name in enumerate(plain) if name == word and at not in taken)
            if keypoint not in places and (place := next(free, None)) is not None:
                places[keypoint] = place
    return [places.get(keypoint) for keypoint in keypoints]
