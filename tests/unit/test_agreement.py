"""Agreement with grown pairs: the compiled kernel against the plain form, and what it must know."""

from __future__ import annotations

import numpy as np
import pytest

from pasdedeux.errors import InputError
from pasdedeux.experiments.agreement import Agreement, plain_agreement
from pasdedeux.kinematics.rotations import normalise, rotmat_from_unitquat
from tests.builders.poses import dancers

_RNG = np.random.default_rng(0)
_KNOWN = dancers(0, 20)
GROWN = np.concatenate([_KNOWN] * 10) + _RNG.normal(scale=0.015, size=(200, 2, 17, 3))
NEAR = _KNOWN + _RNG.normal(scale=0.01, size=_KNOWN.shape)


def test_the_kernel_agrees_with_the_definition() -> None:
    agreement = Agreement(GROWN)
    for pair in [*NEAR, *dancers(2, 10)]:
        terms = agreement.terms(pair)
        # Logs in the hundreds of pairs that nothing is near: relative to the size of the exponents.
        found = (terms.pose, terms.placement, terms.limbs)
        assert found == pytest.approx(plain_agreement(pair, GROWN), rel=1e-6, abs=1e-6)


def test_rigid_motion_changes_nothing_and_no_log_is_above_zero() -> None:
    agreement = Agreement(GROWN)
    turn = rotmat_from_unitquat(normalise(np.array([0.2, -0.5, 0.1, 0.8])))
    for pair in NEAR:
        total = agreement.terms(pair).total
        assert agreement.terms(pair @ turn.T + [1.0, -2.0, 3.0]).total == pytest.approx(total, rel=1e-6)
        assert total <= 1e-9


def test_a_person_out_of_place_or_a_limb_astray_lowers_its_own_term() -> None:
    agreement = Agreement(GROWN)
    for pair in NEAR:
        own = agreement.terms(pair)
        moved = pair.copy()
        moved[1] += [0.0, 0.0, 0.4]
        assert agreement.terms(moved).placement < own.placement - 3.0
        assert agreement.terms(moved).limbs == pytest.approx(own.limbs, abs=1e-6)
        assert agreement.terms(moved).pose == pytest.approx(own.pose, abs=1e-6)
        bent = pair.copy()
        bent[0, 7] = 2.0 * bent[0, 6] - bent[0, 7] + [0.0, 0.2, 0.0]
        assert agreement.terms(bent).limbs < own.limbs
        assert agreement.terms(bent).pose < own.pose
        together = pair.copy()
        together[1] += pair[0].mean(axis=0) - pair[1].mean(axis=0)
        assert agreement.terms(together).contact < -5.0


def test_fewer_grown_pairs_say_the_same_of_what_is_near_them() -> None:
    whole = Agreement(GROWN)
    fewer = whole.among(NEAR[:2], most=60)
    for pair in NEAR[:2]:
        few, every = fewer.terms(pair), whole.terms(pair)
        assert (few.pose, few.placement, few.limbs) == pytest.approx(
            (every.pose, every.placement, every.limbs), abs=0.02
        )


def test_the_nearest_grown_pairs_are_as_far_as_their_joints() -> None:
    moved = GROWN[0] + np.array([[[0.0, 0.0, 0.0]], [[0.0, 0.0, 0.2]]])
    # Each half of the joints is 10 cm off once both centroids coincide.
    assert Agreement(GROWN[:1]).nearest_m(moved) == pytest.approx(0.1, abs=1e-6)
    few = Agreement(np.stack([GROWN[0], moved]))
    assert few.nearest_m(GROWN[0], count=2) == pytest.approx(0.05, abs=1e-6)
    assert few.nearest_m(GROWN[0], count=1) == pytest.approx(0.0, abs=1e-6)


def test_agreement_needs_grown_pairs() -> None:
    with pytest.raises(InputError, match="grown"):
        Agreement(GROWN[:0])
