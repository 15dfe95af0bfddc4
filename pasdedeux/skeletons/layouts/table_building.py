"""How the tables of a layout are built from what all layouts share."""

from __future__ import annotations

from pasdedeux.skeletons.layouts.layout import Table

Limbs = dict[str, tuple[str, str]]
"""For each joint of a limb, without its side, the names of the left and the right source joint."""

LIMB_JOINTS = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")


def both_sides(limbs: Limbs) -> dict[str, str]:
    """Spell a limb table out for `left_` and `right_`."""
    table = {f"left_{joint}": left for joint, (left, _) in limbs.items()}
    return table | {f"right_{joint}": right for joint, (_, right) in limbs.items()}


def working_tables(
    *, limbs: Limbs, trunk: Table, spine: Table, neck_base: str, head: Table, nose: str
) -> dict[str, Table]:
    """Return the tables of the three working skeletons.

    Args:
        limbs: shoulder, elbow, wrist, hip, knee, ankle, toe.
        trunk: pelvis, spine1, spine2, spine3, neck, left_collar, right_collar of body22.
        spine: spine, chest of pair17.
        neck_base: Joint at the base of the neck.
        head: Weights of the head (ear height, on the neck's line) under the key "head".
        nose: Joint or added point for the nose.
    """
    left_shoulder, right_shoulder = limbs["shoulder"]
    left_hip, right_hip = limbs["hip"]
    shared = both_sides({joint: limbs[joint] for joint in LIMB_JOINTS})
    return {
        "pair17": {
            **shared,
            **spine,
            **head,
            "pelvis": {left_hip: 0.5, right_hip: 0.5},
            "neck": {neck_base: 0.4, left_shoulder: 0.3, right_shoulder: 0.3},
        },
        "op14": {**shared, "head": nose, "neck": {left_shoulder: 0.5, right_shoulder: 0.5}},
        "body22": {**both_sides(limbs), **trunk, **head},
    }
