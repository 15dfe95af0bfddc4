"""Weights of the energy's terms; see `terms`."""

from __future__ import annotations

from typing import Annotated

import numpy as np
import numpy.typing as npt
from pydantic import Field

from pasdedeux.interaction.contacts import Contacts
from pasdedeux.settings import Settings

__all__ = ["Weights"]

Array = npt.NDArray[np.float64]

Weight = Annotated[float, Field(ge=0, allow_inf_nan=False)]


class Weights(Settings):
    """Weights of the terms, one set for every take; per square metre."""

    laplacian: Weight = Field(1.0, description="Interaction mesh, w_L")
    smoothness: Weight = Field(40.0, description="Second difference of the change against plain FK at 30 Hz, w_S")
    reference: Weight = Field(
        0.03, gt=0, description="Pull towards plain FK, w_R; decides what no other term does, alike at every scale"
    )
    contact_hand: Weight = Field(60.0, description="Contacts of a hand or foot, w_C")
    contact_body: Weight = Field(30.0, description="Contacts of other parts of two bodies")
    contact_direction: Weight = Field(
        0.02, le=1, description="Share k of a contact's weight that keeps its direction, not only its distance"
    )
    stance: Weight = Field(
        4000.0,
        description="Horizontal velocity of what stands at 30 Hz, w_F; so stiff that a foot stays where it is put down",
    )
    floor: Weight = Field(100.0, description="Height of joints near the floor, w_H")
    bending: Weight = Field(
        0.05,
        description="Bending of the spine against plain FK's, per square radian, w_B; without it short spine bones "
        "fold like a carpenter's rule to make a torso shorter, which costs the other terms next to nothing",
    )
    girdle: Weight = Field(10.0, description="Rigidity of girdle and hips, w_G")
    clearance: Weight = Field(110.0, description="Penetration of the partner beyond the source's, w_K")
    clearance_self: Weight = Field(20.0, description="Penetration of one's own body beyond the source's and plain FK's")
    fixed: Weight = Field(1e3, description="Pull of a person held fixed towards the source")

    def of_contacts(self, contacts: Contacts) -> Array:
        """Return the weight of each contact (T, M)."""
        grade = self.contact_body + (self.contact_hand - self.contact_body) * contacts.hand.max(axis=-1)
        return np.asarray(grade * contacts.weights)
