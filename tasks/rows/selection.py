"""Pairs that represent all of a study: repaired ones, else draws, grown and filled ones, with their origins."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pasdedeux.errors import InputError
from pasdedeux.plain_text import counted
from pasdedeux.sampling.prior import PriorSettings
from pasdedeux.sampling.seeds import seed_quality
from pasdedeux.sampling.selection import MIN_LOG_PRIOR, PairSelector
from pasdedeux.verdict import Level
from storage_schema import ArtifactRef, Manifest, Store
from tasks.priors import read_limits
from tasks.rows.draw_sets import density_of, is_chain, is_set, knows_annotations, reference_to
from tasks.stage.facts import DrawFacts
from tasks.stage.judgements import verdict_of
from tasks.stage.kept import kept

READS = ("draws", "seeds", "chain_info", "joint_limits")
"""Tables of a study that pairs are selected by; the last one may be missing."""
_SHARED = ("seed_index", "sequence_id", "sequence_frame", "sequence_person_id", "log_prior", "pair17_m")
_OWN = {"draws": ("density", "chain", "draw"), "seeds": ("parent_seed_index",)}
"""Columns that selected pairs have of draws and of seeds: of both, and of one alone."""


@dataclass(frozen=True)
class SelectedPairs:
    """Selected pairs, and how many they were selected from.

    Args:
        columns: Columns of the table `selected_pairs`; none where nothing is plausible.
        refs: Artifacts that they are in.
        num_draws: Draws of chains, but for those of the prior alone; none where there are repaired pairs.
        num_grown: Grown and filled pairs; none where there are repaired pairs.
        num_repaired: Repaired pairs.
        num_plausible: How many of them all are plausible.
        num_independent: Effective sample size of all chains, and number of grown, filled and repaired pairs that
            differ, both among plausible pairs.
        radius_m: D_C below which two pairs counted as one, metres.
    """

    columns: Mapping[str, Any]
    refs: tuple[ArtifactRef, ...]
    num_draws: int
    num_grown: int
    num_repaired: int
    num_plausible: int
    num_independent: float
    radius_m: float

    def in_words(self) -> str:
        """Describe the selection, its sources, and the number of independent pairs."""
        origins = {"draw": self.num_draws, "grown or filled pair": self.num_grown, "repaired pair": self.num_repaired}
        named = [counted(count, thing) for thing, count in origins.items() if count]
        return (
            f"{len(self.columns.get('rank', ())):,} pairs, at least {100 * self.radius_m:.0f} cm from each other, of "
            f"{' and '.join(named)}, {self.num_plausible:,} of them plausible, which are worth "
            f"{self.num_independent:,.0f} independent ones"
        )


@dataclass(frozen=True)
class _ChainWorth:
    """A chain: the number of independent pairs that each draw counts for, and its verdict."""

    share: float
    verdict: str
    reason: str


@dataclass(frozen=True)
class _PlausibleRows:
    """Plausible pairs of an artifact: number of the first of them, and their rows."""

    first: int
    manifest: Manifest
    rows: np.ndarray


@kept()
def select_pairs(store: Store, refs: tuple[ArtifactRef, ...], count: int) -> SelectedPairs:
    """Select up to `count` pairs from a study's artifacts with the tables of `READS`; others are ignored.

    If pairs were repaired, only these are selected from: they come from grown and filled pairs, and draws of chains
    lie farther from real pairs.  Draws of the prior alone, a baseline, are skipped.  A pair is plausible if it
    keeps the joint limits and has a log prior of at least `MIN_LOG_PRIOR`.  One artifact is in memory at a time, and
    all pairs of no chain that differ.

    Raises:
        InputError: The diagnostics of a chain are missing.
    """
    manifests = [store.manifest(ref) for ref in refs]
    drawn = [manifest for manifest in manifests if "draws" in manifest.tables and knows_annotations(manifest)]
    repaired = [manifest for manifest in drawn if not is_chain(manifest)]
    grown = [] if repaired else [manifest for manifest in manifests if is_set(manifest)]
    drawn = repaired or drawn
    limits = read_limits(store, refs)
    chains = _read_chains(store, manifests)
    selector = PairSelector(count)
    num_single = sum(manifest.tables[_table(manifest)].rows for manifest in (*grown, *drawn) if not is_chain(manifest))
    singles = PairSelector(1, min_room=num_single)  # of no chain: distinct pairs over all artifacts
    parts: list[_PlausibleRows] = []
    first = num_plausible = 0
    num_independent = 0.0
    for manifest in (*grown, *drawn):
        table = store.read(manifest.ref, _table(manifest), columns=["log_prior", "pair17_m"])
        pairs, log_prior = np.asarray(table["pair17_m"]), np.asarray(table["log_prior"])
        rows, share = np.flatnonzero(log_prior >= MIN_LOG_PRIOR), 1.0
        if is_chain(manifest):
            share = _chain_of(chains, manifest).share
            num_plausible += len(rows)
        elif len(rows):
            if is_set(manifest):  # no chain leaves the joint limits
                prior = PriorSettings.model_validate(dict(manifest.parameters), extra="ignore")
                rows = rows[seed_quality(pairs[rows], limits, prior).is_possible]
            num_plausible += len(rows)
            rows = rows[singles.add(pairs[rows], np.ones(len(rows)))]
        selector.add(pairs[rows], np.full(len(rows), share))
        num_independent += share * len(rows)
        parts.append(_PlausibleRows(first, manifest, rows))
        first += len(rows)
    selection = selector.selection()
    which = np.searchsorted([part.first for part in parts], selection.index, side="right") - 1
    chosen = [
        (parts[at], parts[at].rows[number - parts[at].first]) for at, number in zip(which, selection.index, strict=True)
    ]
    columns: dict[str, Any] = {}
    if chosen:
        distance_m = np.where(np.isfinite(selection.distance_m), selection.distance_m, np.nan)
        columns = {"rank": np.arange(len(chosen)), "distance_m": distance_m, "weight": selection.weight}
        columns |= _origins(store, chosen, chains)
    return SelectedPairs(
        columns=columns,
        refs=tuple(dict.fromkeys(part.manifest.ref for part, _ in chosen)),
        num_draws=0 if repaired else sum(manifest.tables["draws"].rows for manifest in drawn),
        num_grown=sum(manifest.tables["seeds"].rows for manifest in grown),
        num_repaired=sum(manifest.tables["draws"].rows for manifest in repaired),
        num_plausible=num_plausible,
        num_independent=num_independent,
        radius_m=selection.radius_m,
    )


def _read_chains(store: Store, manifests: Sequence[Manifest]) -> dict[tuple[Any, ...], _ChainWorth]:
    """Return all chains by density, seed and number; one that never moved is worth one pair."""
    chains = {}
    for manifest in manifests:
        if "chain_info" in manifest.tables:
            table = store.read(manifest.ref, "chain_info")
            for row in range(table.num_rows):
                num_draws = float(table["num_draws"][row])
                size = float(np.clip(np.nan_to_num(table["ess_min"][row], nan=1.0), 1.0, num_draws))
                place = (str(table["density"][row]), int(table["seed_index"][row]), int(table["chain"][row]))
                chains[place] = _ChainWorth(size / num_draws, table["verdict"][row], table["reason"][row])
    return chains


def _table(manifest: Manifest) -> str:
    return "seeds" if "seeds" in manifest.tables else "draws"


def _chain_of(chains: Mapping[tuple[Any, ...], _ChainWorth], manifest: Manifest) -> _ChainWorth:
    """Return the chain that a segment is of."""
    facts = DrawFacts.of(manifest)
    if (place := (facts.density, facts.seed_index, facts.chain)) not in chains:
        raise InputError(f"chain {facts.chain} of {manifest.partition} has no diagnostics; run its study again")
    return chains[place]


def _origin_of(manifest: Manifest) -> str:
    if "draws" in manifest.tables:
        return "draw" if is_chain(manifest) else "repaired"
    return density_of(manifest).removesuffix("_seeds")


def _origins(
    store: Store, chosen: Sequence[tuple[_PlausibleRows, np.int64]], chains: Mapping[tuple[Any, ...], _ChainWorth]
) -> dict[str, list[Any]]:
    """Return the origin of the chosen rows of artifacts, as columns, reading each artifact once."""
    origins: dict[int, dict[str, Any]] = {}
    for part in {part.first: part for part, _ in chosen}.values():
        name, verdict = _table(part.manifest), verdict_of(part.manifest)
        thought = {"verdict": verdict.level.value, "reason": verdict.reason} if verdict else {}
        if is_chain(part.manifest):
            chain = _chain_of(chains, part.manifest)
            thought = {"verdict": chain.verdict, "reason": chain.reason}
        table = store.read(part.manifest.ref, name, columns=[*_SHARED, *_OWN[name]])
        for rank, row in ((rank, row) for rank, (part_of_row, row) in enumerate(chosen) if part_of_row is part):
            origins[rank] = {
                "verdict": Level.NOT_JUDGED.value,
                "reason": "",
                **thought,
                "origin": _origin_of(part.manifest),
                "reference": f"{reference_to(name, part.manifest.ref)}#{row}",
                **dict.fromkeys(column for columns_of_table in _OWN.values() for column in columns_of_table),
                **{column: table[column][row] for column in table},
            }
    return {name: [origins[rank][name] for rank in range(len(chosen))] for name in origins[0]}
