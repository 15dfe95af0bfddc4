"""Known contacts of a take: stated by a study or a duet, or read from a table."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

from pydantic import Field, ValidationError, field_validator, model_validator

from pasdedeux.errors import FormatError, InputError
from pasdedeux.formats.text import Lines
from pasdedeux.interaction.objects import FLOOR, MovingObjects
from pasdedeux.people.names import person_index, person_names
from pasdedeux.settings import Settings, first_problem
from pasdedeux.skeletons import BODY22, Skeleton

Letter = Annotated[str, Field(pattern="^[A-Z]$")]
"""One of the first 26 people of a take: A is the first."""
PersonName = Annotated[str, Field(pattern="^[A-Z]{1,2}$")]
"""A person of a take, as `person_name` names them."""


class UserContact(Settings):
    """A stated contact, which replaces detected contacts between the two bones."""

    joint_a: str = Field(description="Joint of the first person in which the bone ends, by its name in body22")
    joint_b: str | None = Field(None, description="Joint of the second person in which the bone ends")
    object: str | None = Field(
        None,
        min_length=1,
        description="What is touched in place of a second person: an object of the take by its name, or floor",
    )
    share_a: float = Field(1.0, ge=0, le=1, description="Where on the first bone: 0 at its beginning, 1 at the joint")
    share_b: float = Field(1.0, ge=0, le=1, description="The same on the second bone, or from an object's start to end")
    person_a: PersonName = Field("A", description="The first person")
    person_b: PersonName = Field("B", description="The second person, who may be the first")
    start_frame: int = Field(0, ge=0, description="First frame")
    stop_frame: int = Field(description="Frame after the last")
    weight: float = Field(1.0, ge=0, le=10, description="1 in contact, 0 not in contact whatever the distance")

    @field_validator("joint_a", "joint_b")
    @classmethod
    def _is_a_joint(cls, joint: str | None) -> str | None:
        if joint is not None and joint not in BODY22.joint_names:
            raise ValueError(f"joint '{joint}' is not in body22: {', '.join(BODY22.joint_names)}")
        return joint

    @model_validator(mode="after")
    def _has_frames(self) -> UserContact:
        if (self.joint_b is None) == (self.object is None):
            raise ValueError("joint_b or object is needed, and not both")
        if self.joint_a == self.joint_b and self.person_a == self.person_b:
            raise ValueError(f"{self.person_a}'s {self.joint_a} touches nothing but itself")
        if self.stop_frame <= self.start_frame:
            raise ValueError(f"frames {self.start_frame} to {self.stop_frame} are none")
        return self

    @property
    def is_of_floor(self) -> bool:
        """Whether the floor is touched."""
        return self.object == FLOOR

    @property
    def persons(self) -> tuple[int, ...]:
        """Numbers of the people; one if an object or the floor is touched."""
        names = [self.person_a] if self.object else [self.person_a, self.person_b]
        return tuple(map(person_index, names))

    def bones(self, skeleton: Skeleton, objects: MovingObjects | None) -> tuple[int, int]:
        """Return the child joints of the two bones, the joints of all people numbered through; -1, ... for objects."""
        first = self.persons[0] * skeleton.num_joints + skeleton.index(self.joint_a)
        if self.joint_b is not None:
            return first, self.persons[1] * skeleton.num_joints + skeleton.index(self.joint_b)
        assert objects is not None
        assert self.object is not None
        return first, -1 - objects.names.index(self.object)

    def within(self, start: int, stop: int) -> UserContact | None:
        """Return the part of the contact in frames `start` to `stop`, counted from `start`; None if there is none."""
        first, last = max(self.start_frame, start), min(self.stop_frame, stop)
        changed = {"start_frame": first - start, "stop_frame": last - start}
        return self.model_copy(update=changed) if first < last else None


def check_contacts(
    stated: Sequence[UserContact], *, name: str, num_frames: int, num_people: int, objects: MovingObjects | None
) -> None:
    """Refuse contacts with frames, people or objects that a take does not have.

    Raises:
        InputError: The message has the contact in words, and the names that exist.
    """
    things = (*(objects.names if objects else ()), FLOOR)
    for contact in stated:
        other = contact.object or f"{contact.person_b}'s {contact.joint_b}"
        what = f"{name}: contact of {contact.person_a}'s {contact.joint_a} and {other}"
        if max(contact.persons) >= num_people:
            raise InputError(f"{what}, but the people are {', '.join(person_names(num_people))}")
        if contact.object and contact.object not in things:
            raise InputError(f"{what}, but what there is to be touched is {', '.join(things)}")
        if contact.stop_frame > num_frames:
            raise InputError(
                f"{what} over frames {contact.start_frame} to {contact.stop_frame}; allowed are frames within 0 to "
                f"{num_frames}"
            )


def read_contacts(data: bytes) -> tuple[UserContact, ...]:
    """Read a CSV with the fields of `UserContact` as columns and one contact per row; empty cells mean the default.

    Raises:
        FormatError: A column, joint or value is not known or allowed; the line is named.
    """
    with Lines(data, "table of contacts") as lines:
        contacts = []
        for row in lines.table((), list(UserContact.model_fields))[1]:
            try:
                contacts.append(UserContact.model_validate({name: value for name, value in row.items() if value}))
            except ValidationError as error:
                raise FormatError(first_problem(error)) from None
    return tuple(contacts)
