"""Sample pairs from a density of your own: the right hands of two people meet.

python examples/custom_density.py

To use it in studies, register it as described in docs/extending.md.
"""

import numpy as np

from pasdedeux.choreography.duets import make_duet
from pasdedeux.formats.rigs.working_poses import derive_working_poses
from pasdedeux.plausibility.joint_limits import JointLimits
from pasdedeux.sampling.chain import ChainState, run_segment
from pasdedeux.sampling.densities.density import Likelihood, PairDensity
from pasdedeux.sampling.parameters import PairChart
from pasdedeux.sampling.prior import PhysicalPrior
from pasdedeux.sampling.proposals.blocks import GaussianBlocks
from pasdedeux.skeletons import PAIR17
from pasdedeux.skeletons.layouts import LAYOUTS


class HandsMeet(Likelihood):
    """exp(-d^2 / 2 sigma^2) of the distance d between the right wrists."""

    sigma_m = 0.05
    wrist = PAIR17.index("right_wrist")

    def log_likelihood(self, pair_m, *, at_least=-np.inf):
        """Return the log for a pair (2, 17, 3), metres."""
        return self.plain(pair_m)

    def plain(self, pair_m):
        """Return the same by definition."""
        apart_m = np.linalg.norm(pair_m[0, self.wrist] - pair_m[1, self.wrist])
        return -0.5 * (apart_m / self.sigma_m) ** 2


duet = make_duet("waltz", duration_s=0.5)
people = [derive_working_poses(motion, LAYOUTS["body22"]).pair17_m for motion in duet.motions]
chart = PairChart(np.stack(people, axis=1)[0])
likelihood = HandsMeet()
target = PairDensity(chart, PhysicalPrior(chart, JointLimits.published()), likelihood)
state = ChainState(chart.seed_parameters(), target.seed_evaluation)
state, draws = run_segment(np.random.default_rng(0), state, target, GaussianBlocks().propose, num_draws=100, thin=10)
for number in range(0, 100, 20):
    pair_m = chart.positions(draws.parameters[number])
    apart_m = np.linalg.norm(pair_m[0, HandsMeet.wrist] - pair_m[1, HandsMeet.wrist])
    print(f"draw {number}: right wrists {100 * apart_m:.1f} cm apart, log density {draws.log_density[number]:.1f}")
