"""Retarget a hug to a child: one person at 0.6 and 0.8 of the size, contacts kept, compared with plain kinematics.

python examples/retarget_hug_to_child.py
"""

from pasdedeux.augmentation import Augmenter, Source, uniform_variations
from pasdedeux.choreography.duets import make_duet

duet = make_duet("hug", duration_s=2.0, rate_hz=30.0)
augmenter = Augmenter(Source(duet.positions_m(), duet.rate_hz, "hug"), user_contacts=duet.known_contacts(duet.rate_hz))
for variant in augmenter.solve(uniform_variations([0.6, 0.8], ("B",))):
    quality = variant.quality
    print(
        f"{variant.variation.variant_id}: {variant.verdict.level.name.lower()}, contacts drift by "
        f"{1000 * quality.contact_drift_m:.1f} mm (plain kinematics {1000 * quality.contact_drift_fk_m:.1f})"
    )
