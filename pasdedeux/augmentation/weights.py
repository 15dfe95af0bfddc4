"""Weights of the energy's terms; see `terms`."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt

from pasdedeux.augmentation.contacts import BodyPart, body_parts
from pasdedeux.errors import InputError

__all__ = ["Weights"]

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Weights:
    """Weights of the terms, one set for every take; per square metre.

    Args:
        laplacian: Interaction mesh, w_L.
        smoothness: Second difference of x at 30 Hz, w_S.
        reference: Pull towards plain forward kinematics, w_R; settles what nothing else does, alike at every scale.
        contact_extremity: Contact pairs of two hands or feet.
        contact_mixed: Contact pairs of a hand or foot with another body part.
        contact_limb: Contact pairs in which an elbow or knee is the finest part.
        contact_torso: Contact pairs of two torso joints.
        contact_direction: Share k of a contact's weight that keeps its direction too, from 0 to 1; contacts of two
            hands or feet keep all of it.
        stance: Horizontal velocity of stance feet at 30 Hz, w_F.
        floor: Height of joints near the floor, w_H.
        bending: Bending of the spine against r's, per square radian, w_B; without it short spine bones fold like a
            carpenter's rule to make a torso shorter, which costs the other terms next to nothing.
        girdle: Rigidity of girdle and hips, w_G.
        clearance: Penetration of the partner beyond the source's, w_K.
        clearance_self: Penetration of one's own body beyond the source's and plain forward kinematics'.
        fixed: Pull of a person held fixed towards the source.

    Raises:
        InputError: A negative or non-finite weight, or no reference weight.
    """

    laplacian: float = 1.0
    smoothness: float = 40.0
    reference: float = 0.03
    contact_extremity: float = 60.0
    contact_mixed: float = 12.0
    contact_limb: float = 30.0
    contact_torso: float = 30.0
    contact_direction: float = 0.02
    stance: float = 70.0
    floor: float = 100.0
    bending: float = 0.05
    girdle: float = 10.0
    clearance: float = 110.0
    clearance_self: float = 20.0
    fixed: float = 1e3

    def __post_init__(self) -> None:
        """Check the weights."""
        for field in fields(self):
            value = getattr(self, field.name)
            if not (np.isfinite(value) and value >= 0) or (field.name == "reference" and value == 0):
                raise InputError(
                    f"weight '{field.name}' is {value:g}: allowed is 0 or more, and above 0 for 'reference'"
                )
        if self.contact_direction > 1:
            raise InputError(f"weight 'contact_direction' is {self.contact_direction:g}: it is a share, up to 1")

    @property
    def contact_grades(self) -> Array:
        """Weight of each joint pair (22, 22) by the finer of its two body parts."""
        parts = body_parts()
        finer, coarser = np.maximum.outer(parts, parts), np.minimum.outer(parts, parts)
        by_finer = np.array([self.contact_torso, self.contact_limb, self.contact_mixed])
        return np.where(coarser == BodyPart.EXTREMITY, self.contact_extremity, by_finer[finer])

    @property
    def direction_shares(self) -> Array:
        """Share of each joint pair's weight (22, 22) that keeps its direction."""
        parts = body_parts()
        return np.where(np.minimum.outer(parts, parts) == BodyPart.EXTREMITY, 1.0, self.contact_direction)
