"""Keep hands on an object: two people hold a stick, one is scaled, and the stick moves as captured.

python examples/object_between_two.py
"""

import numpy as np

from pasdedeux.augmentation import Augmenter, Source, uniform_variations
from pasdedeux.choreography.duets import make_duet
from pasdedeux.interaction.objects import MovingObjects
from pasdedeux.skeletons import BODY22

duet = make_duet("push_hands", duration_s=1.0, rate_hz=30.0)
positions_m = duet.positions_m()
wrist = BODY22.index("right_wrist")
ends_m = positions_m[:, :, wrist]  # the stick reaches from one right wrist to the other
stick = MovingObjects(("stick",), ends_m[:, None], np.array([0.02]))
augmenter = Augmenter(Source(positions_m, duet.rate_hz, "stick", objects=stick))
(variant,) = augmenter.solve(uniform_variations([1.15], ("B",)))
off_m = np.linalg.norm(variant.positions_m[:, :, wrist] - ends_m, axis=-1)
print(f"B at 1.15: {variant.verdict.level.name.lower()}; wrists within {1000 * off_m.max():.0f} mm of the stick's ends")
