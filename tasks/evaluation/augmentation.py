"""Topic `augmentation`: quality of the variants of each take, beside plain forward kinematics."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array
from pasdedeux.augmentation.augment import Augmenter
from pasdedeux.augmentation.quality import FIGURES
from pasdedeux.augmentation.settings import AugmentationSettings
from pasdedeux.augmentation.source import Source, points_of, reference_motion
from pasdedeux.augmentation.variations import Variation, variant_in_words
from pasdedeux.evaluation.motion_players import links_of
from pasdedeux.evaluation.pictures import (
    CurvePanel,
    Picture,
    curve_figure,
    pack_player,
    people_panel,
    shown_frames,
    times_shown,
)
from pasdedeux.evaluation.scores import Score, scores_of
from pasdedeux.evaluation.verdicts import Criterion, Items
from pasdedeux.interaction.contacts import Contacts, stated_contacts
from pasdedeux.interaction.known_contacts import UserContact
from pasdedeux.skeletons import BODY22
from pasdedeux.spread import evenly_spread
from storage_schema import ArtifactRef, Store, TableData
from tasks.augmentation import batch_of, solver_variants
from tasks.evaluation.topic import Topic, TopicResult
from tasks.rows.takes import read_take, read_variants
from tasks.stage import Parameters, Shard, StageInputs
from tasks.stage.facts import TakeFacts, VariantFacts

_OURS, _PLAIN = "interaction_mesh", "naive_fk"
_FK_DRIFT = "contact_drift_fk_m"
QUALITY_COLUMNS = {
    "estimated_gap_m": "m",
    **{name: figure.unit for name, figure in FIGURES.items() if figure.kind == "float" and name != _FK_DRIFT},
}
"""Scored columns of a variant's quality, with their units."""
_SAMPLE_S = 1.0
"""Seconds in the middle of a take that are also solved with guaranteed descent."""
_SAMPLE_VARIANTS = 2
"""Variants of a take that are solved this way too, evenly spread."""


def _plan(inputs: StageInputs, _: Parameters) -> list[Shard]:
    """Plan one shard per take that has variants."""
    shards = []
    for take in inputs.of("poses"):
        take_id = TakeFacts.of(take).take_id
        variants = [manifest for manifest in solver_variants(inputs) if VariantFacts.of(manifest).take_id == take_id]
        if variants:
            shards.append(TOPIC.shard(inputs, take_id, take=[take], variants=variants))
    return shards


class _ShownAugmentation(NamedTuple):
    """Input of a take's pictures: motions (T, P, 22, 3), metres, by name, and scale and quality of all variants."""

    take_id: str
    source: Source
    motions_m: Mapping[str, Array]
    scale: Array
    columns: Mapping[str, Array]


def _compute(shard: Shard, store: Store) -> TopicResult[_ShownAugmentation]:
    """Score the variants of one take, and choose the extremes to be shown."""
    take, parts = shard.ref("take"), shard.refs("variants")
    facts = TakeFacts.of(store.manifest(take))
    take_id = facts.take_id
    tables = [store.read(ref, "variant_quality") for ref in parts]
    names = ("variant_id", "verdict", "reason", "uniform_scale", "bone_scale", _FK_DRIFT, *QUALITY_COLUMNS)
    columns = {name: np.concatenate([table[name] for table in tables]) for name in names}
    variant_ids = columns["variant_id"].tolist()
    failed = np.flatnonzero(columns["verdict"] == "fail")
    notes = []
    if len(failed):
        first = f"{variant_ids[failed[0]]}, {columns['reason'][failed[0]]}"
        notes = [f"{take_id}: {len(failed)} of {len(variant_ids)} variants fail, for example {first}."]
    if not np.isfinite(columns["contact_drift_m"]).any():
        notes.append(f"{take_id}: the source has no contacts, so contact drift cannot be measured.")
    source, solved = read_take(store, take).source, batch_of(store.manifest(parts[0]))
    held = tuple(contact for contact in solved.contacts if contact.weight > 0 and not contact.is_of_floor)
    contacts, whose = source.contacts(solved.contacts), "detected in the source"
    if held:
        contacts = stated_contacts(held, source.num_frames, BODY22, source.objects)
        whose = "stated with the take" if solved.contacts == facts.contacts else "stated by the study"
    if contacts.weights.size:
        notes.append(f"{take_id}: contacts are {whose}.")
    scale = np.array([_furthest_from_1(scales) for scales in columns["uniform_scale"]])
    drawn = {variant_ids[at] for at in _extremes(scale, columns["contact_drift_m"])}
    shown = {"source": source.positions_m}

    def motions() -> Iterator[tuple[Array, Array]]:
        for variant_id, bone_scale, motion in _variants(store, parts, tables):
            if variant_id in drawn:
                shown[variant_id] = motion
            yield bone_scale, motion

    drifts = contact_drifts(contacts, source, motions())
    scales = columns["bone_scale"].astype(np.float64).reshape(-1, source.num_people, BODY22.num_joints)
    scores = [
        *contact_scores(drifts, item=take_id),
        *quality_scores(columns, item=take_id),
        *gap_scores(source, scales, solved, solved.contacts, item=take_id),
    ]
    times_s = np.tile(drifts.frames / source.rate_hz, len(variant_ids))
    values = {method: drift_m.ravel() for method, drift_m in drifts.found_m.items()}
    items = {"": Items(values, [take_id] * len(times_s), times_s, len(variant_ids))} if len(drifts.frames) else {}
    return TopicResult(scores, notes, items, (_PLAIN,), _ShownAugmentation(take_id, source, shown, scale, columns))


def _draw(shown: _ShownAugmentation) -> Iterator[Picture]:
    """Show the extremes beside the source, and drift over scale where anything is in contact."""
    take_id = shown.take_id
    caption = (
        f"{take_id}: the source, its smallest and its largest variant, and the variant with the largest "
        "contact drift (Li et al. 2024, fig. 4). Green: contacts of the source. Good: green lines stay "
        f"short. {'; '.join(f'{name}: {variant_in_words(name)}' for name in list(shown.motions_m)[1:])}."
    )
    yield Picture(f"variants-{take_id}.player.json", caption, variant_player(shown.source, shown.motions_m))
    if np.isfinite(shown.columns["contact_drift_m"]).any():
        caption = (
            f"{take_id}: contact drift by scale, with plain forward kinematics as baseline (dashed). Good: close to 0."
        )
        yield Picture(f"drift-{take_id}.svg", caption, drift_figure(take_id, shown.scale, shown.columns))


def _furthest_from_1(scales: np.ndarray) -> float:
    """Return the scale (person,) furthest from 1; NaN if one is NaN, as scales that are not uniform are.

    >>> _furthest_from_1(np.array([1.0, 0.8, 1.0]))
    0.8
    """
    return float(scales[np.argmax(np.abs(scales - 1.0))])


def _variants(
    store: Store, parts: Sequence[ArtifactRef], tables: Sequence[TableData]
) -> Iterator[tuple[str, Array, Array]]:
    """Yield name, scales (P, 22) and motion (T, P, 22, 3) of every variant."""
    for ref, table in zip(parts, tables, strict=True):
        motions = read_variants(store, ref)
        for variant_id, scale, motion in zip(table["variant_id"], table["bone_scale"], motions, strict=True):
            yield variant_id, scale.reshape(-1, BODY22.num_joints), motion.astype(np.float64)


def _extremes(scale: Array, drift_m: Array) -> set[int]:
    """Return the variants to draw: smallest and greatest scale, and the worst contact drift."""
    known, worst = np.nan_to_num(scale, nan=1.0), np.nan_to_num(drift_m, nan=-1.0)
    return {int(np.argmin(known)), int(np.argmax(known)), int(np.argmax(worst))}


def quality_scores(columns: Mapping[str, npt.NDArray[Any]], *, item: str) -> list[Score]:
    """Return mean and worst of every quality column (variant,), contact drift beside its baseline, and the verdicts."""
    scores = []
    measured = [(name, name, _OURS) for name in QUALITY_COLUMNS]
    for figure, column, method in (*measured, ("contact_drift_m", _FK_DRIFT, _PLAIN)):
        finite = columns[column][np.isfinite(columns[column])]
        if len(finite):
            metric = figure.removesuffix("_m")
            figures = {f"{metric}_mean": finite.mean(), f"{metric}_worst": finite.max()}
            scores += scores_of(figures, method, QUALITY_COLUMNS[figure], item=item, count=len(finite))
    verdicts = columns["verdict"].tolist()
    counts = {f"variants_{level}": verdicts.count(level) for level in ("pass", "warn", "fail")}
    return scores + scores_of(counts, _OURS, item=item, count=len(verdicts))


@dataclass(frozen=True)
class ContactDrifts:
    """Change of the contact distances of variants, metres.

    Args:
        is_hand: Whether a contact is of hands or feet, (contact,); a contact counts once for each frame in which it
            holds.
        frames: The frame of each contact, (contact,).
        found_m: By method, the drifts of each variant (variant, contact).
    """

    is_hand: npt.NDArray[np.bool_]
    frames: npt.NDArray[np.int64]
    found_m: Mapping[str, Array]


def contact_drifts(contacts: Contacts, source: Source, variants: Iterable[tuple[Array, Array]]) -> ContactDrifts:
    """Return how far contact distances change, of hands and feet and of bodies, beside plain FK.

    Args:
        contacts: Contacts of the take: the stated ones if it has any, otherwise those found.
        source: The take.
        variants: Scales (P, 22) and motion (T, P, 22, 3) of each.
    """
    held = np.nonzero(contacts.is_held)
    is_hand = contacts.num_hands[held] > 0
    before = contacts.held_distances(points_of(source.positions_m))
    by_method: dict[str, list[Array]] = {_OURS: [], _PLAIN: []}
    for scale, motion in variants:
        plain = reference_motion(source, scale[None])[0]
        for method, moved in zip(by_method, (motion, plain), strict=True):
            by_method[method].append(np.abs(contacts.held_distances(points_of(moved)) - before))
    drifts = {method: np.array(rows).reshape(len(rows), len(is_hand)) for method, rows in by_method.items()}
    return ContactDrifts(is_hand, held[0], drifts)


def contact_scores(drifts: ContactDrifts, *, item: str) -> list[Score]:
    """Return median, 95th percentile and worst over contacts, frames and variants of a take, of hands and of bodies."""
    scores = []
    for name, is_mine in (("hand", drifts.is_hand), ("body", ~drifts.is_hand)):
        for method, drift_m in drifts.found_m.items():
            mine = drift_m[:, is_mine].ravel()
            if len(mine):
                values = zip(("median", "p95", "worst"), np.percentile(mine, [50.0, 95.0, 100.0]), strict=True)
                figures = {f"{name}_contact_drift_{which}": value for which, value in values}
                scores += scores_of(figures, method, "m", item=item, count=len(mine))
    return scores


def gap_scores(
    source: Source,
    bone_scale: Array,
    settings: AugmentationSettings,
    contacts: Sequence[UserContact] = (),
    *,
    item: str,
) -> list[Score]:
    """Return the distance of the bulk solver's result from guaranteed descent on a sample, beside its own estimate.

    The sample is the second in the middle of the take, for the first and the last variant.

    Args:
        source: The take.
        bone_scale: Scales of its variants (variant, P, 22).
        settings: How variants were solved; the sample is always of the bulk solver.
        contacts: Contacts stated by the user.
        item: Name of the take.
    """
    middle, half = source.num_frames // 2, max(int(_SAMPLE_S * source.rate_hz / 2.0), 1)
    window = slice(max(middle - half, 0), min(middle + half, source.num_frames))
    sample, stated = source.window(window, contacts)
    bulk, best = (
        Augmenter(sample, settings.model_copy(update={"solver": solver}), user_contacts=stated).solve(
            [Variation(str(index), bone_scale[index]) for index in evenly_spread(len(bone_scale), _SAMPLE_VARIANTS)]
        )
        for solver in ("bulk", "polished")
    )
    moved = [np.linalg.norm(a.positions_m - b.positions_m, axis=-1).mean() for a, b in zip(bulk, best, strict=True)]
    estimated = [variant.estimated_gap_m or 0.0 for variant in bulk]
    excess = [a.energy / max(b.energy, 1e-12) - 1.0 for a, b in zip(bulk, best, strict=True)]
    figures = {"sample_gap_mean": np.mean(moved), "sample_gap_worst": max(moved)}
    figures |= {"sample_estimated_gap_mean": np.mean(estimated), "sample_estimated_gap_worst": max(estimated)}
    energies = {"sample_energy_excess_worst": max(excess)}
    return [
        score
        for values, unit in ((figures, "m"), (energies, ""))
        for score in scores_of(values, _OURS, unit, item=item, count=len(bulk))
    ]


def drift_figure(take_id: str, scale: Array, columns: Mapping[str, Array]) -> bytes:
    """Draw contact drift against the scale (variant,), ours beside plain forward kinematics; SVG bytes."""
    order = np.argsort(scale)
    order = order[np.isfinite(scale[order])]
    drifts = {_OURS: columns["contact_drift_m"], _PLAIN: columns[_FK_DRIFT]}
    panel = CurvePanel(
        "mean change of contact distance (mm)",
        {method: (scale[order], 1e3 * drift[order]) for method, drift in drifts.items()},
        {_PLAIN},
    )
    return curve_figure([panel], title=f"{take_id}: contacts kept", x_label="scale of the scaled person")


def variant_player(source: Source, motions_m: Mapping[str, Array]) -> bytes:
    """Show motions (frame, P, 22, 3), metres, by name, side by side with the source's contacts as green lines."""
    frames, rate_hz = shown_frames(source.num_frames, source.rate_hz)
    contacts = source.contacts()
    objects = source.objects.ends_m[frames] if source.objects else None
    panels = []
    for name, motion in motions_m.items():
        panels.append(people_panel(name, BODY22, motion[frames], links_of(contacts, motion)[frames], objects))
    return pack_player(panels, rate_hz=rate_hz, labels=times_shown(frames, source.num_frames, source.rate_hz))


TOPIC = Topic(
    name="augmentation",
    heading="Augmentation",
    introduction="The same motion for bodies of other sizes, with contacts kept. The baseline applies the joint angles "
    "of the source to the new bones, so hands miss each other.",
    reads=("variants", "variant_quality", "poses"),
    plan=_plan,
    compute=_compute,
    draw=_draw,
    criteria=(Criterion("contact_drift_mean", "drift of contacts (stated or detected)", "m", "variants", (_OURS,)),),
)
