"""A duet: the motions of two people or more, and contacts and stances that are known by construction."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from string import ascii_uppercase
from typing import ClassVar, Self, TypeVar

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from pasdedeux.arrays import Array
from pasdedeux.choreography.anthropometry import Body, make_body
from pasdedeux.choreography.figure import SIDES, Figure
from pasdedeux.interaction.known_contacts import UserContact
from pasdedeux.kinematics import Motion
from pasdedeux.settings import Settings
from pasdedeux.skeletons import BODY22

CLOTH_M = 0.004
"""Cloth between two bodies that touch."""


class DuetStyle(Settings):
    """Parameters of every duet; each duet adds its own."""

    num_people: ClassVar[int] = 2

    duration_s: float = Field(10.0, ge=0.5, le=600.0, description="Length, seconds; frames lie at 0, 1 / rate, ...")
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
        """Mean of the given heights."""
        return float(np.mean(self.heights_m))

    @property
    def bodies(self) -> tuple[Body, ...]:
        """The bodies of all people."""
        missing = (self.mean_m,) * (self.num_people - len(self.heights_m))
        return tuple(map(make_body, (*self.heights_m, *missing)))

    def vary(self, count: int) -> Array:
        """Return `count` numbers in -1..1 of this variation; zeros for variation 0."""
        if self.variation == 0:
            return np.zeros(count)
        return np.random.default_rng(np.random.SeedSequence(self.variation)).uniform(-1.0, 1.0, count)


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

    def position_m(self, positions_m: Array) -> Array:
        """Return the point (frame, 3) from everybody's positions (frame, person, 22, 3)."""
        child = BODY22.index(self.bone)
        end = positions_m[:, self.person, child]
        start = positions_m[:, self.person, BODY22.parents[child]]
        return np.asarray(start + self.fraction * (end - start))


@dataclass(frozen=True)
class Contact:
    """A known contact: two points that keep a constant distance from one time to another.

    Args:
        name: What touches what.
        point_a: A point of one person.
        point_b: A point of the other person.
        start_s: First time at which it holds.
        stop_s: Time from which on it need not hold.
        distance_m: Distance of the two points while it holds: sum of the radii there, plus the gap if there is one.
    """

    name: str
    point_a: BonePoint
    point_b: BonePoint
    start_s: float
    stop_s: float
    distance_m: float


@dataclass(frozen=True)
class Stance:
    """A foot that stands: `foot` ankle and toe are constant from `start_s` to `stop_s` (exclusive), both to the bit."""

    person: int
    foot: str
    start_s: float
    stop_s: float


Interval = TypeVar("Interval", Contact, Stance)


@dataclass(frozen=True)
class Duet:
    """The motion of two people or more with its truth.

    Args:
        name: Which dance.
        motions: Person A, B, ... on `body22`, world frame, Y up, floor at 0.
        bodies: Sizes and girths.
        contacts: Known contacts, by start.
        stances: Known stances, by person and foot.
        parameters: Everything it was made from.
    """

    name: str
    motions: tuple[Motion, ...]
    bodies: tuple[Body, ...]
    contacts: tuple[Contact, ...]
    stances: tuple[Stance, ...]
    parameters: Mapping[str, object] = field(default_factory=dict)

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

    def at_speed(self, speed: float) -> Duet:
        """Return the same frames, played faster: the rate grows, and all that lasts is shorter."""

        def sooner(interval: Interval) -> Interval:
            return replace(interval, start_s=interval.start_s / speed, stop_s=interval.stop_s / speed)

        return replace(
            self,
            motions=tuple(replace(motion, rate_hz=motion.rate_hz * speed) for motion in self.motions),
            contacts=tuple(map(sooner, self.contacts)),
            stances=tuple(map(sooner, self.stances)),
        )

    def known_contacts(self, rate_hz: float) -> tuple[UserContact, ...]:
        """Return the known contacts of the motion resampled to a rate, as they are stated to what keeps contacts."""
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
                        person_a=ascii_uppercase[a.person],
                        person_b=ascii_uppercase[b.person],
                        start_frame=first,
                        stop_frame=stop,
                    )
                )
        return tuple(stated)


def rest_distance_m(body: Body, other: Body, *bones: str) -> float:
    """Return how far a wrist is from the axis of the partner's bone that it lies on; of several bones the thickest."""
    return max(map(other.radius_m, bones)) + body.radius_m("left_wrist") + CLOTH_M


def wrist_contact(
    name: str,
    person: int,
    side: str,
    bone: str,
    share: float,
    distance_m: float,
    span_s: tuple[float, float] = (0.0, 0.0),
) -> Contact:
    """Return the contact of a person's wrist with the partner's bone, a share of the way along it, over a time."""
    ends = (BonePoint(person, f"{side}_wrist"), BonePoint(1 - person, bone, share))
    return Contact(name, *ends, *span_s, distance_m)


def finish(name: str, style: DuetStyle, figures: tuple[Figure, ...], contacts: list[Contact]) -> Duet:
    """Make the duet of solved figures: motions, stances from the feet, contacts that fall into its time."""
    stop = style.duration_s
    contacts = [replace(c, start_s=max(0.0, c.start_s), stop_s=min(stop, c.stop_s)) for c in contacts]
    stances = [
        Stance(person=person, foot=side, start_s=max(0.0, plant.land_s), stop_s=min(stop, plant.lift_s))
        for person, figure in enumerate(figures)
        for side, foot in zip(SIDES, figure.feet, strict=True)
        for plant in foot.plants
        if plant.lift_s > 0.0 and plant.land_s < stop
    ]
    return Duet(
        name=name,
        motions=tuple(figure.motion(style.rate_hz) for figure in figures),
        bodies=tuple(figure.body for figure in figures),
        contacts=tuple(sorted((c for c in contacts if c.start_s < c.stop_s), key=lambda contact: contact.start_s)),
        stances=tuple(stances),
        parameters=style.model_dump(),
    )
