"""Terms of a density put together: a logistic combination of standardised terms, fitted on real and corrupted pairs.

The weights say what each term adds to the others.  They are to be fitted on other takes than those judged.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pasdedeux.errors import InputError

__all__ = ["Combination"]

Array = npt.NDArray[np.float64]

_MAX_TERM = 4.0
"""Standardised terms end here on both sides: no term may decide alone."""
_RIDGE = 0.02
"""Weight of the squared weights against the mean log loss: terms say much the same."""


@dataclass(frozen=True)
class Combination:
    """A weighted sum of standardised terms.

    Args:
        terms: Their names.
        centre: Mean of each term over real pairs, (term,).
        spread: Standard deviation of each over real pairs, (term,); 1 where all are the same.
        weights: What a standard deviation of each counts, (term,).
    """

    terms: tuple[str, ...]
    centre: Array
    spread: Array
    weights: Array

    @classmethod
    def fitted(
        cls, terms: Sequence[str], real: Sequence[Mapping[str, Array]], corrupted: Sequence[Mapping[str, Array]]
    ) -> Combination:
        """Fit to kinds of corruption, each with the terms of its real pairs (n,) and of the corrupted ones (m,).

        Logistic regression with a small ridge; each kind counts the same, real ones as much as
        corrupted ones.

        Raises:
            InputError: There is no kind, or one without pairs.
        """
        from sklearn.linear_model import LogisticRegression  # here: a second that planning need not wait for

        if not real or len(real) != len(corrupted):
            raise InputError(f"a combination is fitted to kinds of pairs, found {len(real)} and {len(corrupted)}")
        rows = [np.stack([one[name] for name in terms], axis=1) for one in (*real, *corrupted)]
        if any(not len(one) for one in rows):
            raise InputError("a combination is fitted to real and corrupted pairs of every kind, and a kind has none")
        sound = np.concatenate(rows[: len(real)])
        spread = sound.std(axis=0)
        blank = cls(tuple(terms), sound.mean(axis=0), np.where(spread > 0.0, spread, 1.0), np.zeros(len(terms)))
        standard = np.concatenate([blank._standardised(one) for one in rows])
        share = np.concatenate([np.full(len(one), 1.0 / (len(rows) * len(one))) for one in rows])
        is_real = np.repeat([1.0, 0.0], [len(sound), len(standard) - len(sound)])
        # Its C weighs the losses, whose shares sum to 1, against half the squared weights.
        model = LogisticRegression(C=1.0 / _RIDGE, solver="newton-cholesky", tol=1e-9)
        model.fit(standard, is_real, sample_weight=share)
        return cls(blank.terms, blank.centre, blank.spread, model.coef_[0])

    def value(self, values: Mapping[str, Array]) -> Array:
        """Return the combination of terms (n,) each, larger where a pair is the likelier, (n,)."""
        return np.asarray(self._standardised(np.stack([values[name] for name in self.terms], axis=1)) @ self.weights)

    def _standardised(self, values: Array) -> Array:
        return np.clip((values - self.centre) / self.spread, -_MAX_TERM, _MAX_TERM)
