"""Stage `views`: the direction of the camera for every annotated pair, as weighted hypotheses with a trust."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass

import numpy as np

from pasdedeux.cameras.views import DEPTH_RULES, ViewOptions, estimate_views
from pasdedeux.plain_text import counted
from pasdedeux.verdict import Level, Verdict
from storage_schema import ArtifactRef, Store
from tasks.priors import default_origin, read_torso_basis
from tasks.rows.annotated_pairs import PairPlace, pairs_by_place, place_columns
from tasks.stage import EarlyPlan, Parameters, Shard, Stage, StageInputs, StageName
from tasks.stage.committing import commit
from tasks.stage.facts import SequenceFacts, ViewFacts, merge_takes, shares_takes

VIEWS = StageName("views", 4)

MAX_WITHOUT_VIEW = 0.25
"""Share of the annotated pairs without a view above which there is a warning."""
MIN_TRUST = 0.5
"""Median trust below which there is a warning: the mean of the hypotheses is that of directions 60 degrees off."""
_MAX_NAMED = 20


class ViewsParameters(ViewOptions, Parameters):
    """Assumptions about cameras and people for the estimation of views."""


def plan(inputs: StageInputs, parameters: ViewsParameters) -> list[Shard]:
    """Plan a shard per artifact of annotations, also for single people, whose shard reports that it skipped them.

    Annotations of a take that the torso basis was learned from are lifted with a default basis instead, so that no
    view rests on the 3D of its own take.
    """
    bases = inputs.of("torso_basis")
    return [
        VIEWS.shard(
            inputs,
            manifest.partition,
            manifest.name,
            parameters,
            {
                "annotations": [manifest],
                "torso_basis": [basis for basis in bases if not shares_takes(manifest, basis)],
            },
        )
        for manifest in inputs.of("annotations")
    ]


def run_shard(shard: Shard, store: Store) -> ArtifactRef:
    """Estimate the views of one artifact's annotated pairs and commit them, with the reasons for skipping others."""
    annotations = store.manifest(shard.ref("annotations"))
    bases = [store.manifest(ref) for ref in shard.refs("torso_basis")]
    pairs = _read_pairs(store, annotations.ref)
    estimates = estimate_views(
        pairs.px,
        read_torso_basis(store, shard.all_inputs),
        confidence=pairs.confidence,
        camera_index=np.unique([place.sequence_id for place in pairs.places], return_inverse=True)[1],
        options=shard.options(ViewsParameters),
    )
    psi, phi = estimates.angles()
    columns = {
        **place_columns(pairs.places[number] for number in estimates.annotation.tolist()),
        "hypothesis": estimates.hypothesis,
        "depth_rule": [DEPTH_RULES[rule] for rule in estimates.depth_rule],
        "flip": estimates.flip,
        "root_depth_m": estimates.root_depth_m,
        "direction": estimates.direction,
        "psi_rad": psi,
        "phi_rad": phi,
        "weight": estimates.weight,
        "trust": estimates.trust[estimates.annotation],
        "metres_per_pixel": estimates.metres_per_pixel,
    }
    without = np.flatnonzero(~estimates.is_lifted)
    skipped = list(pairs.skipped)
    if len(without):
        frames = Counter(pairs.places[number].sequence_id for number in without.tolist())
        skipped += _in_words(frames, "fewer than 4 torso joints of one of the two people were seen")
    seen = SequenceFacts.of(annotations)
    facts = ViewFacts(
        takes=merge_takes(annotations, *bases),
        learned_takes=merge_takes(*bases),
        torso_basis="prior takes" if bases else default_origin([annotations]),
        sequence_ids=seen.sequence_ids,
        purpose=seen.purpose,
        is_held_out=seen.is_held_out,
        num_annotations=len(pairs.places),
        num_without_view=len(without),
        num_hypotheses=len(estimates.weight),
        size_ratio=estimates.size_ratio,
        skipped=skipped,
    )
    verdict = _verdict(
        len(pairs.places),
        len(without),
        estimates.trust[estimates.is_lifted],
        seen.num_persons,
    )
    return commit(shard, store, tables={"views": columns}, facts=facts, verdict=verdict)


def _verdict(num_pairs: int, num_without: int, trust: np.ndarray, num_persons: int) -> Verdict:
    """Return how far the hypotheses of the views agree, and whether most annotated pairs have any."""
    median = float(np.median(trust)) if len(trust) else math.nan
    level, reason = Level.PASS, ""
    if not num_pairs:
        level = Level.PASS if num_persons < 2 else Level.WARN
        reason = "no annotated frame shows two people who are partners"
    elif num_without == num_pairs:
        level, reason = Level.FAIL, f"none of {num_pairs} annotated pairs shows enough of both torsos for a view"
    elif num_without > MAX_WITHOUT_VIEW * num_pairs:
        level, reason = Level.WARN, f"{num_without} of {num_pairs} annotated pairs have no view"
    elif median < MIN_TRUST:
        level, reason = Level.WARN, "the hypotheses of most views lie far apart"
    figure = "trust in views (1: all hypotheses agree)"
    mean = float(np.mean(trust)) if len(trust) else math.nan
    return Verdict(level, reason, figure=figure, value=mean, count=len(trust) or 1, thing="images")


@dataclass(frozen=True)
class _AnnotatedPartners:
    """Annotated partners by their places, the smaller id first as person A, and sentences on the others."""

    places: tuple[PairPlace, ...]
    px: np.ndarray
    confidence: np.ndarray
    skipped: tuple[str, ...]


def _read_pairs(store: Store, ref: ArtifactRef) -> _AnnotatedPartners:
    table = store.read(
        ref,
        "annotations",
        columns=["sequence_id", "frame", "person_id", "partner_id", "is_key", "pair17_px", "pair17_confidence"],
    )
    people = pairs_by_place(table, np.asarray(table["is_key"]))
    places = tuple(sorted(place for place, rows in people.items() if len(rows) == 2))
    skipped: list[str] = []
    for number in sorted({len(rows) for rows in people.values()} - {2}):
        others = Counter(place.sequence_id for place, rows in people.items() if len(rows) == number)
        skipped += _in_words(others, "one of the pair is annotated" if number else "nobody has a partner")
    rows = np.array([[row for _, row in sorted(people[place].items())] for place in places], dtype=int).reshape(-1, 2)
    return _AnnotatedPartners(
        places=places,
        px=np.asarray(table["pair17_px"], dtype=np.float64)[rows],
        confidence=np.asarray(table["pair17_confidence"], dtype=np.float64)[rows],
        skipped=tuple(skipped),
    )


def _in_words(frames: Counter[str], reason: str) -> list[str]:
    """Say for each sequence how many frames were skipped; after twenty the rest together."""
    named = sorted(frames.items())
    sentences = [f"{sequence}: {counted(count, 'frame')} skipped, {reason}" for sequence, count in named[:_MAX_NAMED]]
    rest = named[_MAX_NAMED:]
    if rest:
        total = sum(count for _, count in rest)
        sentences.append(f"{len(rest)} more sequences: {total} frames skipped, {reason}")
    return sentences


STAGE = Stage(
    *VIEWS,
    reads=("annotations", "torso_basis"),
    writes=("views",),
    parameters=ViewsParameters,
    plan=plan,
    run_shard=run_shard,
    meaning="view hypotheses of annotated pairs",
    needs="annotations of two people ([[ingest.annotations]], [[ingest.videos]], or ingest.virtual_video)",
    early=(EarlyPlan(plan, reads=("torso_basis",), each=("annotations",)),),
)
