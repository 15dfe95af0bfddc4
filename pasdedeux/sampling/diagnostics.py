"""Diagnostics of chains: R-hat and effective sample size of invariants, acceptance, and a verdict in words."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.errors import InputError
from pasdedeux.figure import figure, figures_of
from pasdedeux.interaction.dissimilarity import cartesian_dissimilarity
from pasdedeux.skeletons import PAIR17
from pasdedeux.verdict import Level, Verdict

_LIMB_ANGLES = tuple(
    PAIR17.indices(joints)
    for side in ("left", "right")
    for joints in (
        (f"{side}_shoulder", f"{side}_elbow", f"{side}_wrist"),
        ("neck", f"{side}_shoulder", f"{side}_elbow"),
        ("spine", f"{side}_hip", f"{side}_knee"),
        (f"{side}_hip", f"{side}_knee", f"{side}_ankle"),
    )
)
_JOINT_PAIRS = (
    ("pelvis", "pelvis"),
    ("head", "head"),
    ("left_wrist", "neck"),
    ("right_wrist", "neck"),
    ("neck", "left_wrist"),
    ("neck", "right_wrist"),
    ("left_ankle", "right_ankle"),
    ("right_ankle", "left_ankle"),
)

_MIN_DRAWS = 4
"""Fewest draws for correlations over time."""
MIN_ACCEPTANCE = 0.005
"""Accepted share of proposals below which a chain counts as stuck."""
MAX_RHAT = 1.1
"""R-hat above which chains do not mix (Gelman et al. 2013, section 11.5)."""
MIN_ESS = 100.0
"""Effective sample size of a chain below which it does not mix (Vehtari et al. 2021); half is enough of few draws."""
MAX_AT_CEILING = 0.1
"""Share of draws in the flat top of the truncated density above which a chain counts as having left its range."""
MIN_TRAVELLED_M = 0.01
"""Distance between the first and the last draw below which a chain counts as staying at its start, metres."""


@dataclass(frozen=True)
class ChainReport:
    """Diagnostics of one chain and the verdict on it: columns of `chain_info`, NaN if an invariant never moved."""

    verdict: Verdict
    num_draws: int = figure("Draws kept", words="number of draws")
    acceptance_rate: float = figure("Accepted share of the proposals")
    ess_min: float = figure(
        "Least effective sample size over the invariants of this chain", better="larger", words="effective sample size"
    )
    rhat_max: float = figure("Greatest R-hat over the invariants and the chains of this seed", words="R-hat")
    log_density_first: float = figure("Log density of the seed", words="log density of the seed")
    log_density_mean: float = figure("Mean log density of the draws", words="log density")
    ceiling_share: float = figure("Share of the draws in the flat top of a truncated density")
    sigma_l: float = figure(
        "Bandwidth of the likelihood (lift eq. 9); NaN for a density that reads no annotations", words="bandwidth"
    )
    travelled_m: float = figure("Mean joint distance between the first draw and the last")


FIGURES = figures_of(ChainReport)


def invariants(pair_m: Array) -> Array:
    """Return limb angles (radians) and joint distances (metres), (*batch, 24), of pairs (*batch, 2, joint=17, 3).

    They do not change when the pair moves rigidly.  A limb with an empty bone has angle 0.
    """
    columns = []
    for person in range(2):
        for start, middle, end in _LIMB_ANGLES:
            points = pair_m[..., person, :, :]
            above, below = points[..., start, :] - points[..., middle, :], points[..., end, :] - points[..., middle, :]
            cross = np.linalg.norm(np.cross(above, below), axis=-1)
            columns.append(np.arctan2(cross, np.sum(above * below, axis=-1)))
    for joint, partner_joint in _JOINT_PAIRS:
        gap = pair_m[..., 0, PAIR17.index(joint), :] - pair_m[..., 1, PAIR17.index(partner_joint), :]
        columns.append(np.linalg.norm(gap, axis=-1))
    return np.stack(columns, axis=-1)


def effective_sample_size(values: Array) -> Array:
    """Return the bulk effective sample size (quantity,) of values (chain, draw, quantity); NaN where nothing moved.

    Of ranks of halves of chains (Vehtari et al. 2021); NaN for fewer than four draws.
    """
    from arviz_stats.base.array import array_stats  # here: planning need not wait for it

    return _of_each(array_stats.ess, values)


def rhat(values: Array) -> Array:
    """Return the rank-normalised split R-hat (quantity,) of values (chain, draw, quantity); NaN where nothing moved.

    A single chain is split in two halves first.
    """
    from arviz_stats.base.array import array_stats  # as above

    if len(values) == 1:
        half = values.shape[1] // 2
        values = np.concatenate([values[:, :half], values[:, half : 2 * half]])
    return _of_each(array_stats.rhat, values)


def _of_each(statistic: Callable[..., Array], values: Array) -> Array:
    """Return a statistic (quantity,) of values (chain, draw, quantity); NaN for quantities that never move."""
    values_of_each, has_moved = np.full(values.shape[-1], np.nan), np.ptp(values, axis=(0, 1)) > 0.0
    if values.shape[1] >= _MIN_DRAWS and has_moved.any():
        with np.errstate(divide="ignore", invalid="ignore"):  # chains that stand still give NaN, as they should
            values_of_each[has_moved] = statistic(values[..., has_moved], chain_axis=0, draw_axis=1)
    return values_of_each


def diagnose(
    pair_m: Array,
    log_density: Array,
    num_accepted: Array,
    *,
    thin: int,
    log_ceiling: float,
    log_seed: float = np.nan,
    sigma_l: float = np.nan,
) -> list[ChainReport]:
    """Return a report for each chain of one seed.

    Args:
        pair_m: Draws (chain, draw, person=2, joint=17, 3), metres.
        log_density: Log of the target, (chain, draw).
        num_accepted: Accepted proposals since the draw before, (chain, draw).
        thin: Steps per draw.
        log_ceiling: Log density above which the target is flat.
        log_seed: Log density of the seed.
        sigma_l: Bandwidth of the likelihood; NaN for a density that reads no annotations.

    Raises:
        InputError: There is no draw.
    """
    num_chains, num_draws = log_density.shape
    if num_chains == 0 or num_draws == 0:
        raise InputError("diagnostics need at least one chain with one draw")
    values = invariants(np.asarray(pair_m, dtype=np.float64))
    worst_rhat = _worst(rhat(values), largest=True)
    reports = []
    for chain in range(num_chains):
        acceptance = float(num_accepted[chain].sum() / (num_draws * thin))
        at_ceiling = float(np.mean(log_density[chain] >= log_ceiling))
        first, last = (np.asarray(pair_m[chain, at], dtype=np.float64).reshape(-1, 3) for at in (0, -1))
        travelled = float(cartesian_dissimilarity(last, first))
        ess = _worst(effective_sample_size(values[chain : chain + 1]), largest=False)
        reports.append(
            ChainReport(
                num_draws=num_draws,
                acceptance_rate=acceptance,
                ess_min=ess,
                rhat_max=worst_rhat,
                log_density_first=log_seed,
                log_density_mean=float(log_density[chain].mean()),
                ceiling_share=at_ceiling,
                sigma_l=sigma_l,
                travelled_m=travelled,
                verdict=_judge(num_draws, acceptance, at_ceiling, travelled, ess, worst_rhat),
            )
        )
    return reports


def _judge(
    num_draws: int, acceptance: float, at_ceiling: float, travelled_m: float, ess: float, worst_rhat: float
) -> Verdict:
    """Judge a chain; figures that are unknown count as not mixed."""
    level, reasons = Level.PASS, []
    if acceptance < MIN_ACCEPTANCE:
        level = Level.FAIL
        reasons.append(f"stuck: {acceptance:.2%} of the proposals were accepted, fewer than {MIN_ACCEPTANCE:.1%}")
    elif not (ess >= min(MIN_ESS, num_draws / 2) and worst_rhat <= MAX_RHAT and travelled_m >= MIN_TRAVELLED_M):
        level = Level.WARN
        size = "none can be had" if np.isnan(ess) else f"{ess:.0f} of {num_draws}"
        reasons.append(
            f"not mixed: effective sample size {size}, R-hat {worst_rhat:.2f}, {100 * travelled_m:.1f} cm travelled"
        )
    if at_ceiling > MAX_AT_CEILING:
        level = max(level, Level.WARN, key=lambda level: level.rank)
        reasons.append(f"{at_ceiling:.0%} of the draws lie above the seed's density range, where the target is flat")
    return Verdict(
        level,
        "; ".join(reasons),
        figure=FIGURES["ess_min"].words,
        value=ess,
        baseline=float(num_draws),
        baseline_name="draws kept",
        thing="chains",
    )


def _worst(values: Array, *, largest: bool) -> float:
    if np.isnan(values).any():
        return float("nan")
    return float(values.max() if largest else values.min())
