"""Check a motion of people from any origin: its capture, its contacts, and how it keeps those of its source."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.augmentation import AugmentationSettings, Augmenter, Source
from pasdedeux.augmentation.quality import FIGURES as QUALITY
from pasdedeux.augmentation.quality import FRAME_LIMITS, Quality
from pasdedeux.augmentation.source import points_of
from pasdedeux.augmentation.variations import Variation
from pasdedeux.errors import InputError
from pasdedeux.evaluation.motion_players import links_of
from pasdedeux.evaluation.pictures import PLAYER, Picture, pack_player, people_panel, shown_frames
from pasdedeux.figure import complaints, figure, figures_of, limits_of
from pasdedeux.formats.rigs.placement import floor_shift
from pasdedeux.interaction.contacts import Contacts
from pasdedeux.interaction.surfaces import surface_gaps
from pasdedeux.people.names import person_name
from pasdedeux.plain_text import counted
from pasdedeux.plausibility.capture import FIGURES, PersonCapture
from pasdedeux.skeletons import BODY22
from pasdedeux.verdict import Level, Verdict

_MAX_RATE_HZ = 30.0
"""Highest rate at which contacts are looked for, as in studies."""
_SHOWN_S = 5.0
_BONES = {"bone_error_m": (0.01, 0.03)}
"""A joint between the joints of a foreign rig moves by millimetres along its bone; the solver's bones are exact."""
QUALITY_LIMITS = limits_of(QUALITY) | _BONES
"""Limits of a motion against its source."""


@dataclass(frozen=True)
class TouchFigures:
    """How people touch each other. This is not judged: people may dance apart."""

    num_contacts: int = figure(
        "Contacts: unbroken periods in which two bones of different people touch", words="contacts"
    )
    contact_share: float = figure("Share of the frames in which people touch", words="touching")
    mean_contact_s: float = figure("Mean length of a contact; NaN without one")
    longest_contact_s: float = figure("Length of the longest contact; 0 without one")
    inside_share: float = figure(
        "Share of the frames in which people overlap more deeply than the limit for a capture", words="too deep"
    )


TOUCH = figures_of(TouchFigures)


@dataclass(frozen=True)
class HeldContacts:
    """The contact of the source that is kept worst."""

    worst_contact_m: float | None = figure(
        "Change of the surface distance of the two bones with the largest contact drift, 95th percentile "
        "over its frames; null without a contact",
        (0.01, 0.05),  # variants keep to 6 mm
        words="worst contact",
        complaint="the contact of {worst_contact} drifts by {worst_contact_m:.3f} m",
    )
    worst_contact: str = figure(
        "The two bones with the largest contact drift, such as `A left_wrist and B spine3`; empty without a contact"
    )


HELD = figures_of(HeldContacts)


class CheckedMotion:
    """A motion of people that is to be checked.

    Args:
        name: Its name.
        people_m: body22 (frame, person, 22, 3), metres, y up, wherever its floor is.
        rate_hz: Frames per second.
    """

    def __init__(self, name: str, people_m: Array, rate_hz: float) -> None:
        step = max(1, round(rate_hz / _MAX_RATE_HZ))
        some = people_m[::step]
        placed = some + np.array([0.0, floor_shift(some), 0.0])
        self.name, self.source = name, Source(placed, rate_hz / step, name)

    @cached_property
    def contacts(self) -> Contacts:
        """Contacts of people with each other; of a single person, with the own body."""
        return self.source.contacts()

    @cached_property
    def _augmenter(self) -> Augmenter:
        settings = AugmentationSettings(limits=QUALITY_LIMITS)
        return Augmenter(self.source, settings, frame_limits=FRAME_LIMITS | _BONES)

    def touch(self) -> TouchFigures:
        """Return how people touch each other."""
        spans = list(_spans(self.contacts)) if self.source.num_people > 1 else []
        seconds = [(stop - start) / self.source.rate_hz for start, stop in spans]
        is_touching = np.zeros(self.source.num_frames, dtype=bool)
        for start, stop in spans:
            is_touching[start:stop] = True
        return TouchFigures(
            num_contacts=len(spans),
            contact_share=float(is_touching.mean()),
            mean_contact_s=float(np.mean(seconds)) if seconds else float("nan"),
            longest_contact_s=max(seconds, default=0.0),
            inside_share=float((self._depth_m() > FIGURES["penetration_m"].limits[0]).mean()),  # type: ignore[index]
        )

    def _depth_m(self) -> Array:
        """Return the deepest penetration of any two people (frame,), metres; negative if all are apart."""
        people, radii = self.source.positions_m, self.source.radii_m
        couples = [[a, b] for a in range(people.shape[1]) for b in range(a)]
        gaps = [surface_gaps(people[:, both], radii[both], BODY22).closest_m for both in couples]
        return -np.min(gaps, axis=0) if gaps else np.full(len(people), -np.inf)

    def held_against(self, original: CheckedMotion) -> tuple[Quality, HeldContacts, Verdict]:
        """Compare contacts, floor and smoothness with the source's, and judge how they are kept.

        Raises:
            InputError: The two have different numbers of frames or people, or other rates.
        """
        length, its = (
            f"{counted(source.num_frames, 'frame')} of {counted(source.num_people, 'person')} at {source.rate_hz:g} Hz"
            for source in (self.source, original.source)
        )
        if length != its:
            raise InputError(
                f"it has {length}, its source {original.name} {its}: a variant has the frames of its source"
            )
        lengths, its_lengths = self.source.lengths_m, original.source.lengths_m
        scale = np.where(its_lengths > 0, lengths / np.maximum(its_lengths, 1e-9), 1.0)
        augmenter, positions_m = original._augmenter, self.source.positions_m
        variant = augmenter.assess(Variation(self.name, scale), positions_m)
        held = HeldContacts(None, "")
        if (worst := augmenter.meter.worst_contact(points_of(positions_m))) is not None:
            held = HeldContacts(worst[0], " and ".join(_bone_name(bone) for bone in worst[1]))
        lost = [Verdict(level, said) for _, level, said in complaints(held, HELD, limits_of(HELD))]
        return variant.quality, held, join_verdicts([*lost, variant.verdict])

    def picture(self, said: str, people: Sequence[PersonCapture], original: CheckedMotion | None = None) -> Picture:
        """Return the player: some seconds around its worst jump, beside the same of its source."""
        motions = [motion for motion in (original, self) if motion is not None]
        rate_hz, count = self.source.rate_hz, min(len(motion.source.positions_m) for motion in motions)
        length, worst = min(count, round(_SHOWN_S * rate_hz)), max(people, key=lambda person: person.jump_m)
        jump_s = worst.jump_s if max(person.start_jump_m for person in people) < worst.jump_m else 0.0
        start = int(np.clip(jump_s * rate_hz - length / 2, 0, count - length))
        frames, shown_hz = shown_frames(length, rate_hz)
        panels = []
        for motion in motions:
            contacts = original.contacts if original is not None else self.contacts
            links = links_of(contacts, motion.source.positions_m)[frames + start]
            panels.append(people_panel(motion.name, BODY22, motion.source.positions_m[frames + start], links))
        labels = [f"{(start + frame) / rate_hz:.2f} s" for frame in frames]
        return Picture(f"{self.name}{PLAYER}", said, pack_player(panels, rate_hz=shown_hz, labels=labels))


def join_verdicts(verdicts: Sequence[Verdict]) -> Verdict:
    """Return the worst level of several verdicts with all their reasons, the worst first."""
    ranked = sorted(verdicts, key=lambda verdict: -verdict.level.rank)
    reasons = dict.fromkeys(verdict.reason for verdict in ranked if verdict.reason)
    return Verdict(ranked[0].level if ranked else Level.PASS, "; ".join(reasons))


def _bone_name(bone: int) -> str:
    person, joint = divmod(bone, BODY22.num_joints)
    return f"{person_name(person)} {BODY22.joint_names[joint]}"


def _spans(contacts: Contacts) -> Iterator[tuple[int, int]]:
    """Yield the first frame, and one past the last, of each unbroken contact of two bones."""
    held, bones = contacts.is_held & (contacts.objects < 0), contacts.bones()
    frames, places = np.nonzero(held)
    pairs = bones[frames, places]
    for pair in np.unique(pairs, axis=0):
        when = np.unique(frames[(pairs == pair).all(axis=1)])
        for run in np.split(when, np.flatnonzero(np.diff(when) > 1) + 1):
            yield int(run[0]), int(run[-1]) + 1
