"""Choreography: built-in duets, closed-form two-person motions with known contacts."""

from __future__ import annotations

from pasdedeux.choreography.anthropometry import CAPSULE_RADII, HEIGHT_LIMITS_M, Body, make_body
from pasdedeux.choreography.duet import BonePoint, Contact, Duet, DuetStyle, Stance
from pasdedeux.choreography.duets import DEFAULT_DUETS, DUETS, Dance, draw_styles, duet_torso_basis, make_duet, style_of

__all__ = [
    "CAPSULE_RADII",
    "DEFAULT_DUETS",
    "DUETS",
    "HEIGHT_LIMITS_M",
    "Body",
    "BonePoint",
    "Contact",
    "Dance",
    "Duet",
    "DuetStyle",
    "Stance",
    "draw_styles",
    "duet_torso_basis",
    "make_body",
    "make_duet",
    "style_of",
]
