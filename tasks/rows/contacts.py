"""Contacts as rows: which people or objects touch, and where, in takes, variants and any other `body22` motion.

One definition serves the table `contacts` that is exported, `contacts` of a clip, and windows to train on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from pasdedeux.augmentation import Source, UserContact
from pasdedeux.errors import check_whole
from pasdedeux.people.names import person_names
from pasdedeux.skeletons import BODY22
from storage_schema import ArtifactRef, Store
from tasks.augmentation import batch_of
from tasks.rows.takes import read_take_objects, take_of
from tasks.stage.facts import TakeFacts

if TYPE_CHECKING:
    import pandas as pd

_PARENTS = np.maximum(BODY22.parents, 0)


@dataclass(frozen=True)
class ContactRows:
    """Contacts of a motion, one a row: those that `pasdedeux.interaction.contacts` finds in it, and stated ones.

    Args:
        frame: Frame of the motion (n,).
        person: Person of the first and of the second point (n, 2), 0 for A; -1 for an object.
        bone: Joint of body22 that the bone of each point ends in (n, 2); of an object its number.
        share: Where on the bone (n, 2): 0 at its parent joint, 1 at its child; NaN for an object.
        points_m: Both points (n, 2, 3), on the axes of bones and objects, metres.
        gap_m: Distance of the surfaces there (n,), capsules, metres; negative where they overlap.
        weight: Weight of the contact (n,), from 0 to 1, or as stated.
        is_held: Whether it counts as one where there must be a yes or no (n,).
        objects: Names of the objects.
    """

    frame: npt.NDArray[np.int64]
    person: npt.NDArray[np.int64]
    bone: npt.NDArray[np.int64]
    share: npt.NDArray[np.float64]
    points_m: npt.NDArray[np.float64]
    gap_m: npt.NDArray[np.float64]
    weight: npt.NDArray[np.float64]
    is_held: npt.NDArray[np.bool_]
    objects: tuple[str, ...] = ()

    @classmethod
    def of(cls, source: Source, stated: Sequence[UserContact] = ()) -> ContactRows:
        """Find the contacts of a motion and add the stated ones; one person without objects has none."""
        contacts = source.contacts(tuple(stated))
        frame, at = np.nonzero(contacts.weights > 0.0)
        thing, joints = contacts.objects[frame, at], contacts.bones()[frame, at]
        is_body = np.stack([np.ones_like(thing), thing < 0], axis=-1).astype(bool)
        person, bone = (np.where(is_body, part, -1) for part in np.divmod(joints, BODY22.num_joints))
        points = contacts.ends(source.positions_m.reshape(source.num_frames, -1, 3))[frame, at]
        reach = np.where(is_body, source.radii_m.ravel()[np.maximum(joints, 0)], 0.0)
        if source.objects is not None:
            reach[:, 1] += np.where(thing >= 0, source.objects.radii_m[thing], 0.0)
        return cls(
            frame=frame,
            person=person,
            bone=np.where(is_body, bone, thing[:, None]),
            share=np.where(is_body, contacts.shares[frame, at][:, [1, 3]] * (1.0, -1.0), np.nan),
            points_m=points,
            gap_m=np.linalg.norm(points[:, 0] - points[:, 1], axis=-1) - reach.sum(axis=-1),
            weight=contacts.weights[frame, at],
            is_held=contacts.is_held[frame, at],
            objects=() if source.objects is None else source.objects.names,
        )

    def held_in(self, source: Source) -> ContactRows:
        """Return the same contacts as they lie in another motion of these people, such as a variant of their take.

        Frames, parts of bodies and weights stay; points and gaps are those of the motion.  Objects move as before.
        """
        ends = np.array(self.points_m)
        reach = np.zeros(self.person.shape)
        for end in (0, 1):
            on = self.person[:, end] >= 0
            frame, person, bone = self.frame[on], self.person[on, end], self.bone[on, end]
            parent, child = (source.positions_m[frame, person, joint] for joint in (_PARENTS[bone], bone))
            ends[on, end] = parent + self.share[on, end, None] * (child - parent)
            reach[on, end] = source.radii_m[person, bone]
        if source.objects is not None:
            thing = self.person[:, 1] < 0
            reach[thing, 1] = source.objects.radii_m[self.bone[thing, 1]]
        gap_m = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=-1) - reach.sum(axis=-1)
        return replace(self, points_m=ends, gap_m=gap_m)

    @property
    def distance_m(self) -> npt.NDArray[np.float64]:
        """Distance of both points (n,), metres."""
        return np.asarray(np.linalg.norm(self.points_m[:, 0] - self.points_m[:, 1], axis=-1))

    def columns(self) -> dict[str, Any]:
        """Return them as columns of the table `contacts`, from `frame` on, without times."""
        num_people = int(self.person.max(initial=0)) + 1
        people = np.array([*person_names(num_people), None])  # the last is that of an object
        parts = np.array([*BODY22.joint_names, *self.objects])
        second = np.where(self.person[:, 1] < 0, BODY22.num_joints, 0) + self.bone[:, 1]
        return {
            "frame": self.frame,
            "person": people[self.person[:, 0]].tolist(),
            "bone": parts[self.bone[:, 0]].tolist(),
            "share": self.share[:, 0],
            "point_m": self.points_m[:, 0],
            "partner": people[self.person[:, 1]].tolist(),
            "partner_bone": parts[second].tolist(),
            "partner_share": self.share[:, 1],
            "partner_point_m": self.points_m[:, 1],
            "distance_m": self.distance_m,
            "gap_m": self.gap_m,
            "weight": self.weight,
            "is_held": self.is_held,
        }

    def matrix(self, first: int, stop: int) -> npt.NDArray[np.float32]:
        """Return the weights between the bones of A and those of B in these frames, (frame, 22, 22).

        Raises:
            InputError: The frames are no whole numbers of 0 or more, or the last comes before the first.
        """
        check_whole(first, "first", minimum=0)
        check_whole(stop, "stop", minimum=int(first))
        distances = np.zeros((stop - first, BODY22.num_joints, BODY22.num_joints), dtype=np.float32)
        order = np.argsort(self.person, axis=1)
        bone, person = (np.take_along_axis(ends, order, axis=1) for ends in (self.bone, self.person))
        both = (person == (0, 1)).all(axis=1) & (self.frame >= first) & (self.frame < stop)
        where = (self.frame[both] - first, *bone[both].T)
        np.maximum.at(distances, where, self.weight[both].astype(np.float32))
        return distances

    def pandas(self) -> pd.DataFrame:
        """Return the rows as a data frame: the columns of the table `contacts`, points by their axes."""
        import pandas as pd

        rows: dict[str, Any] = {}
        for name, values in self.columns().items():
            axes = {f"{name.removesuffix('_m')}_{axis}_m": at for at, axis in enumerate("xyz")}
            is_point = name.endswith("point_m")
            rows |= {axis: values[:, at] for axis, at in axes.items()} if is_point else {name: values}
        return pd.DataFrame(rows)


def find_contact_rows(store: Store, ref: ArtifactRef, positions_m: npt.NDArray[Any], name: str) -> ContactRows:
    """Return the contacts of a take or a variant (frame, person, 22, 3), metres, in its own motion.

    A contact stated by the study or a built-in duet is listed for all variants of its take; its gap shows whether they
    keep it.

    Args:
        store: The store.
        ref: The artifact that it is in.
        positions_m: The motion.
        name: Its name, for messages.
    """
    manifest = store.manifest(ref)
    is_variant = "variants" in manifest.tables
    take = take_of(store, ref) if is_variant else ref
    facts = TakeFacts.of(store.manifest(take))
    source = Source(np.asarray(positions_m), facts.rate_hz, name, objects=read_take_objects(store, take))
    return ContactRows.of(source, batch_of(manifest).contacts if is_variant else facts.contacts)
