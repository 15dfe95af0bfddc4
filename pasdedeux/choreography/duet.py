"""A duet: the motions of two or more people, with the contacts and stances of their construction as ground truth."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from pasdedeux.arrays import Array
from pasdedeux.choreography.anthropometry import Physique, make_body
from pasdedeux.choreography.dancer_frames import DancerFrames
from pasdedeux.choreography.geometry import SIDES
from pasdedeux.interaction.known_contacts import UserContact
from pasdedeux.kinematics import Motion
from pasdedeux.people.names import person_name
from pasdedeux.settings import Settings

_NUM_VARIED = 5
"""Number of random values of a variation; no duet uses more."""
MIN_DURATION_S = 0.5


class DuetStyle(Settings):
    """Style of a duet: its length, the dancers' heights, and the variation."""

    num_people: ClassVar[int] = 2

    duration_s: float = Field(
        10.0, ge=MIN_DURATION_S, le=600.0, description="Length, seconds; frames lie at 0, 1 / rate, ..."
    )
    rate_hz: float = Field(60.0, ge=1.0, le=1000.0, description="Frames per second; any rate samples the same motion")
    heights_m: tuple[float, ...] = Field(
        (1.82, 1.65),
        min_length=2,
        description="Standing heights of person A, B, ...; of a trio's C the mean if not given",
    )
    variation: int = Field(
        0, ge=0, description="0 for the duet as written; another number gives another take with slightly other style"
    )
    speed: float = Field(1.0, ge=0.5, le=1.5, description="Speed of everything, over that of the duet as written")

    @model_validator(mode="after")
    def _has_these_people(self) -> Self:
        if len(self.heights_m) > self.num_people:
            raise ValueError(f"{len(self.heights_m)} heights are given for {self.num_people} people")
        return self

    @property
    def time_s(self) -> Array:
        """Times of the frames (frame,)."""
        return np.arange(max(1, round(self.duration_s * self.rate_hz))) / self.rate_hz

    @property
    def mean_m(self) -> float:
        """Mean of the stated heights."""
        return float(np.mean(self.heights_m))

    @property
    def bodies(self) -> tuple[Physique, ...]:
        """The bodies of all people."""
        missing = (self.mean_m,) * (self.num_people - len(self.heights_m))
        return tuple(map(make_body, (*self.heights_m, *missing)))

    @property
    def vary(self) -> tuple[float, ...]:
        """Random values in -1..1 that characterise this variation; zeros for variation 0."""
        if self.variation == 0:
            return (0.0,) * _NUM_VARIED
        generator = np.random.default_rng(np.random.SeedSequence(self.variation))
        return tuple(generator.uniform(-1.0, 1.0, _NUM_VARIED).tolist())


class Dance(DuetStyle):
    """A built-in duet: its style, the motion of trunks and feet, and the contacts of hands."""

    @abstractmethod
    def place(self, person: int) -> DancerFrames:
        """Return a person with trunk and feet over time; the arms hang."""

    @abstractmethod
    def hold(self, figures: Sequence[DancerFrames]) -> list[Contact]:
        """Move everybody's hands to their places, and return the contacts; those outside the duet are cut off."""

    def make(self, name: str) -> Duet:
        """Return the duet: motions, stances of the feet, contacts that fall into its time.

        Another speed samples the same motion over another time at another rate, and plays it at the requested rate.
        """
        speed = self.speed
        stop = self.duration_s * speed
        plain = self.model_copy(update={"duration_s": stop, "rate_hz": self.rate_hz / speed})
        figures = tuple(map(plain.place, range(self.num_people)))

        def within(start_s: float, stop_s: float) -> tuple[float, float]:
            return max(0.0, start_s) / speed, min(stop, stop_s) / speed

        held = [(contact, *within(contact.start_s, contact.stop_s)) for contact in plain.hold(figures)]
        contacts = [replace(contact, start_s=begins, stop_s=ends) for contact, begins, ends in held if begins < ends]
        return Duet(
            name=name,
            motions=tuple(figure.motion(plain.rate_hz * speed) for figure in figures),
            bodies=tuple(figure.body for figure in figures),
            contacts=tuple(sorted(contacts, key=lambda contact: contact.start_s)),
            stances=tuple(
                Stance(person, side, *within(plant.land_s, plant.lift_s))
                for person, figure in enumerate(figures)
                for side, foot in zip(SIDES, figure.feet, strict=True)
                for plant in foot.plants
                if plant.lift_s > 0.0 and plant.land_s < stop
            ),
        )


@dataclass(frozen=True)
class BonePoint:
    """A point on a person's bone: a share of the way from the parent joint (0) to the named joint (1).

    Args:
        person: 0 is A, 1 is B, ...
        bone: Joint of `body22` in which the bone ends.
        fraction: Share of the bone.
    """

    person: int
    bone: str
    fraction: float = 1.0


@dataclass(frozen=True)
class Contact:
    """A known contact: two points that keep a constant distance from one time to another.

    Args:
        point_a: A point of one person.
        point_b: A point of the other person.
        distance_m: Distance of the two points while it holds: sum of the radii there, plus the gap if there is one.
        start_s: First time at which it holds.
        stop_s: Time from which it need not hold; by default the end of the duet.
    """

    point_a: BonePoint
    point_b: BonePoint
    distance_m: float
    start_s: float = 0.0
    stop_s: float = math.inf


@dataclass(frozen=True)
class Stance:
    """A standing foot: `foot` ankle and toe are constant from `start_s` to `stop_s` (exclusive), both to the bit."""

    person: int
    foot: str
    start_s: float
    stop_s: float


@dataclass(frozen=True)
class Duet:
    """The motion of two people or more with its ground truth.

    Args:
        name: Which dance.
        motions: Person A, B, ... on `body22`, world frame, Y up, floor at 0.
        bodies: Sizes and girths.
        contacts: Known contacts, by start.
        stances: Known stances, by person and foot.
    """

    name: str
    motions: tuple[Motion, ...]
    bodies: tuple[Physique, ...]
    contacts: tuple[Contact, ...]
    stances: tuple[Stance, ...]

    @property
    def num_frames(self) -> int:
        """Number of frames."""
        return self.motions[0].num_frames

    @property
    def rate_hz(self) -> float:
        """Frames per second."""
        return self.motions[0].rate_hz

    def positions_m(self) -> Array:
        """Return world positions of everybody (frame, person, 22, 3)."""
        return np.stack([motion.world()[0] for motion in self.motions], axis=1)

    def frames(self, interval: Contact | Stance) -> npt.NDArray[np.intp]:
        """Return the frames (n,) in which a contact or stance holds."""
        time_s = np.arange(self.num_frames) / self.rate_hz
        holds = (time_s >= interval.start_s - 1e-9) & (time_s < interval.stop_s - 1e-9)
        return np.flatnonzero(holds)

    def known_contacts(self, rate_hz: float) -> tuple[UserContact, ...]:
        """Return the known contacts of the motion at another rate, in the form of stated contacts."""
        stated = []
        for contact in self.contacts:
            a, b = sorted((contact.point_a, contact.point_b), key=lambda point: point.person)
            first, stop = (int(np.ceil(time_s * rate_hz - 1e-6)) for time_s in (contact.start_s, contact.stop_s))
            if first < stop:
                stated.append(
                    UserContact(
                        joint_a=a.bone,
                        joint_b=b.bone,
                        share_a=a.fraction,
                        share_b=b.fraction,
                        person_a=person_name(a.person),
                        person_b=person_name(b.person),
                        start_frame=first,
                        stop_frame=stop,
                    )
                )
        return tuple(stated)


def hand_contact(
    person: int, side: str, bone: str, share: float, distance_m: float, start_s: float = 0.0, stop_s: float = math.inf
) -> Contact:
    """Return the contact of a person's wrist with the partner's bone, a share of the way along it, over a time."""
    return Contact(BonePoint(person, f"{side}_wrist"), BonePoint(1 - person, bone, share), distance_m, start_s, stop_s)
