"""Rescale one of three people: the mesh spans all of them, so all contacts are kept.

python examples/three_people.py
"""

import numpy as np

from pasdedeux.augmentation import Augmenter, Source, uniform_variations
from pasdedeux.choreography.duets import make_duet

trio = make_duet("trio", duration_s=1.0, rate_hz=30.0)
source = Source(trio.positions_m(), trio.rate_hz, "trio")
augmenter = Augmenter(source, user_contacts=trio.known_contacts(trio.rate_hz))
(variant,) = augmenter.solve(uniform_variations([1.2], ("C",), num_people=3))
moved_m = np.linalg.norm(variant.positions_m - source.positions_m, axis=-1).mean(axis=(0, 2))
print(
    f"C at 1.2: {variant.verdict.level.name.lower()}, contacts drift by {1000 * variant.quality.contact_drift_m:.1f} mm"
)
print("mean movement: " + ", ".join(f"{name} {100 * moved:.1f} cm" for name, moved in zip("ABC", moved_m, strict=True)))
