"""Weights of the energy's terms, one set for every take, per square metre unless stated otherwise; see `terms`.

They were chosen by the figures of variants of captured and synthetic takes; `docs/decisions/` lists the trials.
"""

from __future__ import annotations

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.interaction.contacts import Contacts

LAPLACIAN = 1.0
"""Interaction mesh, w_L."""
SMOOTHNESS = 40.0
"""Second difference of the change against plain forward kinematics at 30 Hz, w_S."""
REFERENCE = 0.03
"""Pull towards plain forward kinematics, w_R; determines what no other term does, equally at every scale."""
CONTACT_HAND = 60.0
"""Contacts of a hand or foot, w_C."""
CONTACT_BODY = 30.0
"""Contacts of other parts of two bodies."""
CONTACT_DIRECTION = 0.02
"""Share k of a contact's weight that keeps its direction, not only its distance."""
STANCE = 4000.0
"""Horizontal velocity of standing joints at 30 Hz, w_F; so stiff that a foot stays where it is put down."""
FLOOR = 100.0
"""Height of joints near the floor, w_H."""
BENDING = 0.05
"""Bending of the spine against plain forward kinematics', per square radian, w_B; without it short spine bones fold
like a carpenter's rule to make a torso shorter, which costs the other terms next to nothing."""
GIRDLE = 10.0
"""Rigidity of girdle and hips, w_G."""
CLEARANCE = 110.0
"""Penetration of the partner beyond the source's, w_K."""
CLEARANCE_SELF = 20.0
"""Penetration of one's own body beyond the source's and plain forward kinematics'."""
FIXED = 1e3
"""Pull of a person held fixed towards the source."""


def of_contacts(contacts: Contacts) -> Array:
    """Return the weight of each contact (T, M)."""
    grade = CONTACT_BODY + (CONTACT_HAND - CONTACT_BODY) * contacts.hand.max(axis=-1)
    return np.asarray(grade * contacts.weights)
