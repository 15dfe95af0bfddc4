"""Drafts of layouts for unknown joints, from names, tree and pose, for the user to check and correct."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import combinations, permutations

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.errors import InputError
from pasdedeux.skeletons.layouts.fitting import fit_parts, rest_positions
from pasdedeux.skeletons.layouts.layout import Layout
from pasdedeux.skeletons.layouts.motion_files import LAYOUTS
from pasdedeux.skeletons.layouts.names import SIDES, normal_names
from pasdedeux.skeletons.layouts.recognising import NEEDED, NORMAL_NAMES, SEVERAL_PEOPLE
from pasdedeux.skeletons.skeleton import ARM, LEG, Skeleton

_ALIKE = 0.15
"""Largest difference of two limbs of one body, a share of their length."""
_MOST_OF_A_LIMB = 0.6
"""Minimum share of the shorter one of two limbs that is alike."""
_ARM_OF_LEG = 0.68
"""Length of the arm over that of the leg, without hand and foot [Drillis and Contini 1966]."""
_LIMB = 0.15
"""Minimum length of a limb, a share of the longest path in the body."""
_UPPER_TO_LOWER = {"arm": 1.27, "leg": 1.0}
"""Length of the upper arm over the forearm, and of the thigh over the shin [Drillis and Contini 1966]."""
_BEFORE = {"arm": 1.2, "leg": 0.6}
_AFTER = {"arm": 1.0, "leg": 0.9}
"""Largest path lengths from trunk to limb, and from its end to the tip of hand or foot, in upper bones."""
_BENT_COST, _COVER_COST, _FAR_COST, _NO_HEAD_COST = 10.0, 0.1, 2.0, 1.0
_MOST_JOINTS, _MOST_PAIRS = 30, 12
"""Maximum number of joints of a limb and of pairs of limbs that are examined: more than any body has."""
_NECK_HEIGHT = 0.13
"""Maximum height of the base of the neck over the shoulders, in lengths of the trunk."""
_SKULL_AWAY = 0.1
"""Minimum distance of the joint of the skull from the base of the neck, in lengths of the trunk."""
_LIKE_PEOPLE = 0.4
"""Largest difference of the logarithms of the lengths of limbs of two people."""
_TOE_ACROSS, _BENT = 0.1, 0.03
"""Minimum deviation of a foot from the line of the shin, a share of the shin; that of a bent knee, of the leg."""
_SURE_SIDE = 0.5
"""Cosine between the line of the hips and left, as seen from knees and toes, from which the sides are sure."""
_SHORTEST_WORD = 4
"""Minimum length of a known word at the end of a name."""
_END_WORDS = ("end", "nub", "site", "tip")

_BY_NAME, _BY_TREE, _BY_POSE = "by its name", "by tree and pose", "by knees and toes"


@dataclass(frozen=True)
class DraftedPart:
    """A part of a body and its likely joint.

    Args:
        part: As in `Layout.parts`.
        joint: Joint of the file; empty if a needed part has none.
        reason: The evidence.
        is_sure: Whether it need not be checked.
    """

    part: str
    joint: str
    reason: str
    is_sure: bool


@dataclass(frozen=True)
class Draft:
    """The parts of a body in a file.

    Args:
        parts: From the pelvis to the toes; missing ones are derived.
        are_several: Whether there are limbs of several bodies.
        skeleton: The joints of the file.
        rest_offsets: Their offsets (J, 3).
    """

    parts: tuple[DraftedPart, ...]
    are_several: bool
    skeleton: Skeleton = field(repr=False)
    rest_offsets: Array = field(repr=False)

    @property
    def missing(self) -> list[str]:
        """Needed parts without a joint."""
        return [part.part for part in self.parts if not part.joint]

    @property
    def is_whole(self) -> bool:
        """Whether it is a complete layout of one body."""
        return not self.missing and not self.are_several

    def layout(self, name: str) -> Layout:
        """Return the draft as a layout.

        Raises:
            InputError: Needed parts are missing, or there are several bodies.
        """
        if self.are_several:
            raise InputError(SEVERAL_PEOPLE)
        if self.missing:
            raise InputError(f"no joint was found for {', '.join(self.missing)}; write [ingest.mappings.{name}.parts]")
        parts = {part.part: part.joint for part in self.parts}
        return fit_parts(name, "a draft", parts, self.skeleton, self.rest_offsets)

    def toml(self, name: str) -> str:
        """Return the draft as a mapping of a study, with remarks on uncertain parts."""
        lines = [f"[ingest.mappings.{name}.parts]"]
        for part in self.parts:
            line = f"{part.part} = {json.dumps(part.joint, ensure_ascii=False)}"
            if not part.joint:
                line = f"# {part.part} =    # no joint was found: SET IT, it is needed"
            lines.append(line if part.is_sure or not part.joint else f"{line}    # {part.reason}: A GUESS - CHECK IT")
        return "\n".join(lines) + "\n"


def draft_mapping(skeleton: Skeleton, rest_offsets: Array, positions: Array | None = None) -> Draft:
    """Draft a layout for the joints of a file.

    Legs and arms are the two pairs of branches of similar length; the legs are longer.  Names that identify a part take
    precedence.  Sides follow from names, else from the direction of toes and bent knees.

    Args:
        skeleton: The joints of the file.
        rest_offsets: Offset of each joint from its parent, (J, 3), any unit.
        positions: Some frames of the motion (frame, J, 3), same unit, any axes; by default the rest pose.
    """
    places = rest_positions(skeleton, rest_offsets)[None] if positions is None else positions
    return _Drafting(skeleton, rest_offsets, places).draft()


def _vocabulary() -> dict[str, set[str]]:
    """Return the possible parts of each normal name without side, in known layouts."""
    words: dict[str, set[str]] = {}
    for name, layout in LAYOUTS.items():
        for part, entry in layout.parts.items():
            for word in entry.split("|") if isinstance(entry, str) else ():
                side, _, bare = NORMAL_NAMES[name].get(word, "").rpartition(".")
                part_side = next((part_side for part_side in SIDES if part.startswith(part_side)), "")
                if bare and side == part_side:
                    words.setdefault(bare, set()).add("skull" if part == "head" else part.removeprefix(f"{part_side}_"))
    return words


_WORDS = _vocabulary()


@dataclass(frozen=True)
class _Triple:
    """Places on a branch where a limb starts, bends and ends, its length, and its cost: how unlike a limb it is."""

    places: tuple[int, int, int]
    length: float
    cost: float


_Branch = tuple[int, ...]
"""A path through the tree, from the joint that two limbs share to a leaf."""
_Pair = tuple[_Branch, _Branch]


@dataclass(frozen=True)
class _Drafting:
    """The joints and poses of a file, from which parts are found."""

    skeleton: Skeleton
    rest_offsets: Array
    positions: Array

    def draft(self) -> Draft:
        """Return the draft."""
        pairs = self._pairs()
        people = [two for two in permutations(pairs, 2) if not self._joints(two[0]) & self._joints(two[1])]
        legs, arms = min(people, key=self._cost, default=(None, None))
        parts: dict[str, DraftedPart] = {}
        if legs and arms:
            leg = self._triple("leg", legs)
            arm = self._triple("arm", arms, _ARM_OF_LEG * leg.length)
            limbs = {
                "leg": [self._limb("leg", branch, leg.places) for branch in legs],
                "arm": [self._limb("arm", branch, arm.places) for branch in arms],
            }
            is_left_first, reason, is_sure = self._sides(limbs)
            for kind, (first, second) in limbs.items():
                ordered = (first, second) if is_left_first[kind] else (second, first)
                for side, limb in zip(SIDES, ordered, strict=True):
                    for part, joint in limb.items():
                        parts[f"{side}_{part}"] = self._part(f"{side}_{part}", joint, reason, is_sure)
            for part, joint in self._trunk(legs, arms, limbs).items():
                parts[part] = self._part(part, joint)
        needed = {*NEEDED, *(() if {"neck", "skull"} & parts.keys() else ("skull",))}
        limb_parts = (f"{side}_{part}" for side in SIDES for part in ("collar", *ARM, *LEG, "toe"))
        rows = (
            parts.get(part) or (DraftedPart(part, "", "no joint was found", False) if part in needed else None)
            for part in ("pelvis", "neck", "skull", *limb_parts)
        )
        are_several = bool(legs and arms and self._are_several(pairs, legs, arms))
        return Draft(tuple(row for row in rows if row), are_several, self.skeleton, self.rest_offsets)

    def _are_several(self, pairs: Sequence[_Pair], legs: _Pair, arms: _Pair) -> bool:
        """Return whether there are further legs and arms of similar length at other joints."""
        used = self._joints(legs) | self._joints(arms)
        for kind, known in (("leg", legs), ("arm", arms)):
            length = self._triple(kind, known).length
            others = [pair for pair in pairs if pair[0][0] != known[0][0] and not self._joints(pair) & used]
            if not any(abs(np.log(self._triple(kind, pair).length / length)) < _LIKE_PEOPLE for pair in others):
                return False
        return True

    @cached_property
    def _lengths(self) -> Array:
        """Length of the bone that ends in each joint (J,), 0 for the root."""
        parents = [max(parent, 0) for parent in self.skeleton.parents]
        lengths = np.median(np.linalg.norm(self.positions - self.positions[:, parents], axis=-1), axis=0)
        lengths[self.skeleton.root] = 0.0
        return np.asarray(lengths)

    @cached_property
    def _normal(self) -> list[tuple[str, str]]:
        """Side and rest of each joint's normal name."""
        split = (name.rpartition(".") for name in normal_names(self.skeleton.joint_names))
        return [(side, bare) for side, _, bare in split]

    def _means(self, joint: int) -> set[str]:
        """Return the possible parts of a joint's name, or of the end of it, in known layouts."""
        name = self._normal[joint][1]
        ends = (name[at:] for at in range(len(name) - _SHORTEST_WORD + 1))
        return _WORDS.get(name) or next((_WORDS[end] for end in ends if end in _WORDS), set())

    def _part(self, part: str, joint: int, side_reason: str = "", is_side_sure: bool = True) -> DraftedPart:
        """Return a part with its evidence."""
        is_named = part.removeprefix("left_").removeprefix("right_") in self._means(joint)
        reasons = [_BY_NAME if is_named else _BY_TREE, side_reason if side_reason != _BY_NAME or not is_named else ""]
        reason = ", its side ".join(filter(None, reasons))
        return DraftedPart(part, self.skeleton.joint_names[joint], reason, is_named and is_side_sure)

    @cached_property
    def _next(self) -> dict[int, int]:
        """Child of each joint on the longest path outward."""
        far, following = np.zeros(self.skeleton.num_joints), {}
        for joint in reversed(self.skeleton.order[1:]):
            parent, length = self.skeleton.parents[joint], far[joint] + self._lengths[joint]
            if length >= far[parent]:
                far[parent], following[parent] = length, joint
        return following

    def _longest(self, joint: int) -> list[int]:
        """Return the longest path from a joint outward, itself first, up to the maximum number of joints of a limb."""
        way = [joint]
        while way[-1] in self._next and len(way) < _MOST_JOINTS:
            way.append(self._next[way[-1]])
        return way

    def _pairs(self) -> list[_Pair]:
        """Return the pairs of branches from one joint whose bones have similar lengths."""
        body = self._lengths[self._longest(self.skeleton.root)].sum()
        pairs: list[_Pair] = []
        for joint in range(self.skeleton.num_joints):
            ways = [self._longest(child) for child in self.skeleton.children(joint)]
            for first, second in combinations([way for way in ways if self._lengths[way].sum() > _LIMB * body], 2):
                alike = self._num_alike(first, second)
                if alike:
                    pairs.append(((joint, *first[:alike]), (joint, *second[:alike])))
        return sorted(pairs, key=lambda pair: -float(self._lengths[list(pair[0][1:])].sum()))[:_MOST_PAIRS]

    def _num_alike(self, first: Sequence[int], second: Sequence[int]) -> int:
        """Return the number of similar bones from the start of two paths; 0 if they are too few for a limb.

        The ends may differ: one of two hands may have fingers, or hold something.
        """
        shared = min(len(first), len(second))
        bones = self._lengths[list(first[:shared])], self._lengths[list(second[:shared])]
        total = min(self._lengths[list(way)].sum() for way in (first, second))
        are_alike = np.abs(bones[0] - bones[1]) <= _ALIKE * np.maximum(*bones) + _ALIKE / 10 * total
        alike = shared if are_alike.all() else int(np.argmin(are_alike))
        return alike if alike >= 3 and bones[0][:alike].sum() > _MOST_OF_A_LIMB * total else 0

    def _joints(self, pair: _Pair) -> set[int]:
        return {joint for branch in pair for joint in branch[1:]}

    def _cost(self, people: tuple[_Pair, _Pair]) -> float:
        """Return the cost of one pair as legs and the other as arms: proportions, and a head between the arms."""
        legs = self._triple("leg", people[0])
        arms = self._triple("arm", people[1], _ARM_OF_LEG * legs.length)
        return legs.cost + arms.cost + _NO_HEAD_COST * (not self._head(*people))

    def _triple(self, kind: str, pair: _Pair, length: float = 0.0) -> _Triple:
        """Return the places on two paths where a limb starts, bends and ends: straight bones of usual proportions.

        Args:
            kind: arm or leg.
            pair: The paths.
            length: Expected length of the limb; 0 if unknown.
        """
        ways = [list(branch) for branch in pair]
        at = np.mean([np.cumsum(np.concatenate([[0.0], self._lengths[way[1:]]])) for way in ways], axis=0)
        apart = [self.positions[:, way, None] - self.positions[:, None, way] for way in ways]
        chords = np.mean([np.median(np.linalg.norm(vectors, axis=-1), axis=0) for vectors in apart], axis=0)

        def triple(start: int, middle: int, end: int) -> _Triple:
            upper, lower = at[middle] - at[start], at[end] - at[middle]
            if min(upper, lower) <= 0.05 * at[-1]:
                return _Triple((start, middle, end), 0.0, float("inf"))
            bent = max(1.0 - chords[start, middle] / upper, 1.0 - chords[middle, end] / lower)
            far = max(at[start] / upper - _BEFORE[kind], 0.0) + max((at[-1] - at[end]) / upper - _AFTER[kind], 0.0)
            proportion = abs(np.log(upper / lower / _UPPER_TO_LOWER[kind]))
            cover = 1.0 - (upper + lower) / at[-1]
            size = abs(np.log((upper + lower) / length)) if length > 0 else 0.0
            cost = proportion + size + _BENT_COST * bent + _FAR_COST * far + _COVER_COST * cover
            return _Triple((start, middle, end), float(upper + lower), float(cost))

        return min((triple(*places) for places in combinations(range(1, len(at)), 3)), key=lambda limb: limb.cost)

    def _limb(self, kind: str, branch: _Branch, places: tuple[int, int, int]) -> dict[str, int]:
        """Return the joints of a limb by part, from names if these are unambiguous, else from the places."""
        parts = ARM if kind == "arm" else LEG
        inner = [at for at in range(1, len(branch)) if not self._normal[branch[at]][1].endswith(_END_WORDS)]
        named = [[at for at in inner if self._means(branch[at]) == {part}] for part in parts]
        chosen = [matches[0] if len(matches) == 1 else place for matches, place in zip(named, places, strict=True)]
        start, _, end = chosen = chosen if chosen[0] < chosen[1] < chosen[2] else list(places)
        limb = {part: branch[place] for part, place in zip(parts, chosen, strict=True)}
        if kind == "arm" and start > 1:
            limb["collar"] = branch[start - 1]
        if kind == "leg" and end + 1 < len(branch):
            toe = branch[end + 1]
            shin = self.positions[:, limb["ankle"]] - self.positions[:, limb["knee"]]
            foot = self.positions[:, toe] - self.positions[:, limb["ankle"]]
            across = np.linalg.norm(np.cross(foot, shin), axis=-1) / np.maximum((shin**2).sum(axis=-1), 1e-12)
            if np.median(across) > _TOE_ACROSS:
                limb["toe"] = toe
        return limb

    def _sides(self, limbs: Mapping[str, Sequence[Mapping[str, int]]]) -> tuple[dict[str, bool], str, bool]:
        """Return for each kind of limb whether the first is the left one, the evidence, and whether that is sure."""
        named = {
            kind: [{self._normal[joint][0] for joint in limb.values()} - {""} for limb in both]
            for kind, both in limbs.items()
        }
        if all(sides in ([{"left"}, {"right"}], [{"right"}, {"left"}]) for sides in named.values()):
            return {kind: sides[0] == {"left"} for kind, sides in named.items()}, _BY_NAME, True
        place = self.positions
        hips, shoulders = (
            [place[:, limb[part]] for limb in limbs[kind]] for kind, part in (("leg", "hip"), ("arm", "shoulder"))
        )
        up = _units(shoulders[0] + shoulders[1] - hips[0] - hips[1])
        front = np.zeros_like(up)
        for leg in limbs["leg"]:
            hip, knee, ankle = (place[:, leg[part]] for part in LEG)
            length = np.maximum(np.linalg.norm(hip - ankle, axis=-1, keepdims=True), 1e-12)
            front += np.clip((knee - (hip + ankle) / 2) / length / _BENT, -1, 1)
            if "toe" in leg:
                front += _units(place[:, leg["toe"]] - ankle)
        left = np.cross(up, _units(front - (front * up).sum(axis=-1, keepdims=True) * up))
        across = _units(hips[0] - hips[1])
        cosine = float(np.median((across * left).sum(axis=-1)))
        arms = float(np.median(((shoulders[0] - shoulders[1]) * across).sum(axis=-1)))
        legs_left = cosine > 0
        return {"leg": legs_left, "arm": legs_left if arms > 0 else not legs_left}, _BY_POSE, abs(cosine) > _SURE_SIDE

    def _trunk(self, legs: _Pair, arms: _Pair, limbs: Mapping[str, Sequence[Mapping[str, int]]]) -> dict[str, int]:
        """Return the existing joints of pelvis, neck and skull."""
        node, chest = legs[0][0], arms[0][0]
        trunk = {} if node == chest else {"pelvis": node}
        head = self._head(legs, arms)
        if len(head) > 1 and self._normal[head[-1]][1].endswith(_END_WORDS):
            head = head[:-1]
        if not head:
            return trunk
        hips, shoulders = (
            np.mean([self.positions[:, limb[part]] for limb in limbs[kind]], axis=0)
            for kind, part in (("leg", "hip"), ("arm", "shoulder"))
        )
        length = float(np.median(np.linalg.norm(shoulders - hips, axis=-1))) or 1.0
        up = _units(shoulders - hips)
        heights = {j: float(np.median(((self.positions[:, j] - shoulders) * up).sum(axis=-1))) / length for j in head}
        named = {part: [joint for joint in head if part in self._means(joint)] for part in ("neck", "skull")}
        necks = named["neck"] or [joint for joint in head[:1] if heights[joint] < _NECK_HEIGHT]
        base = self.positions[:, necks[0]] if necks else shoulders
        skulls = named["skull"] or [joint for joint in head if joint not in necks[:1]]
        away = {j: float(np.median(np.linalg.norm(self.positions[:, j] - base, axis=-1))) / length for j in skulls}
        farthest = max(away, key=away.__getitem__, default=-1)
        skull = next((joint for joint in skulls if away[joint] > _SKULL_AWAY), farthest)
        trunk |= {"neck": necks[0]} if necks else {}
        return trunk | ({"skull": skull} if away.get(skull) else {})

    def _head(self, legs: _Pair, arms: _Pair) -> list[int]:
        """Return the longest path between the arms that does not lead to the legs."""
        used = {*(branch[1] for branch in (*arms, *legs)), *self.skeleton.path(legs[0][0])}
        ways = [self._longest(child) for child in self.skeleton.children(arms[0][0]) if child not in used]
        return max(ways, key=lambda way: float(self._lengths[way].sum()), default=[])


def _units(vectors: Array) -> Array:
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.where(lengths > 0, lengths, 1.0))
