"""Topic `augmentation`: how good the variants of each take are."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from pasdedeux.evaluation.variants import (
    QUALITY_COLUMNS,
    VariantQualities,
    contact_drifts,
    contact_scores,
    drift_figure,
    gap_scores,
    quality_scores,
    variant_player,
    verdict_scores,
)
from pasdedeux.evaluation.verdicts import Criterion
from pasdedeux.interaction.contacts import stated_contacts
from pasdedeux.skeletons import BODY22
from storage_schema import ArtifactRef, Store, TableData
from tasks.augmentation import batch_of
from tasks.evaluation.topic import Topic, TopicResult
from tasks.facts import TakeFacts, VariantFacts
from tasks.stage import Parameters, Shard, StageInputs
from tasks.takes import read_take


def _plan(inputs: StageInputs, _: Parameters) -> list[Shard]:
    """Plan one shard per take that has variants."""
    found = []
    for take in inputs.of("poses"):
        take_id = TakeFacts.of(take).take_id
        variants = [manifest for manifest in inputs.of("variants") if VariantFacts.of(manifest).take_id == take_id]
        if variants:
            found.append(TOPIC.shard(inputs, take_id, take=[take], variants=variants))
    return found


def _run(shard: Shard, store: Store) -> TopicResult:
    """Score the variants of one take and draw the extremes beside the source."""
    take, parts = shard.ref("take"), shard.refs("variants")
    take_id = TakeFacts.of(store.manifest(take)).take_id
    tables = [store.read(ref, "variant_quality") for ref in parts]
    names = [name for table in tables for name in table["variant_id"]]
    homes = [ref for ref, table in zip(parts, tables, strict=True) for _ in range(table.num_rows)]
    qualities = VariantQualities(
        take_id=take_id,
        scale=np.array([_furthest_from_1(scales) for table in tables for scales in table["uniform_scale"]]),
        values={name: np.concatenate([table[name] for table in tables]) for name in QUALITY_COLUMNS},
        drift_fk_m=np.concatenate([table["contact_drift_fk_m"] for table in tables]),
        verdicts=[verdict for table in tables for verdict in table["verdict"]],
    )
    notes = [
        f"{table['variant_id'][row]}, {table['reason'][row]}"
        for table in tables
        for row in np.nonzero(table["verdict"] == "fail")[0]
    ]
    if notes:
        notes = [f"{take_id}: {len(notes)} of {len(names)} variants fail, such as {notes[0]}."]
    has_contacts = bool(np.isfinite(qualities.values["contact_drift_m"]).any())
    if not has_contacts:
        notes.append(f"{take_id}: nothing is in contact in the source, so contact drift is not known.")
    source = read_take(store, take).source
    solved = batch_of(store.manifest(parts[0]))
    held = tuple(contact for contact in solved.contacts if contact.weight > 0 and not contact.is_of_floor)
    contacts = source.contacts(solved.contacts)
    if held:
        contacts = stated_contacts(held, source.num_frames, BODY22, source.objects)
    if contacts.weights.size:
        whose = "found in the source"
        if held:
            is_known = solved.contacts == TakeFacts.of(store.manifest(take)).contacts
            whose = "known of the take" if is_known else "stated by the study"
        notes.append(f"{take_id}: contacts of hands and of bodies are those {whose}.")
    drifts = contact_drifts(contacts, source, _motions(store, parts, tables))
    kept = contact_scores(drifts, item=take_id)
    scales = np.concatenate([table["bone_scale"] for table in tables]).astype(np.float64)
    scales = scales.reshape(-1, source.num_people, BODY22.num_joints)
    gaps = gap_scores(source, scales, solved, solved.contacts, item=take_id)
    drawn = _extremes(qualities)

    def read(chosen: Iterable[int]) -> dict[str, np.ndarray]:
        return {names[i]: _read_variant(store, homes[i], names[i], source.num_people) for i in chosen}

    pictures = {f"variants-{take_id}.player.json": variant_player(source, read(drawn))}
    if has_contacts:
        pictures[f"drift-{take_id}.svg"] = drift_figure(qualities)
    captions = {
        f"variants-{take_id}.player.json": f"{take_id}: the source, its variants of the smallest and greatest size, "
        "and that whose contacts moved most; what touches in the source is black. Better: black lines stay short.",
        f"drift-{take_id}.svg": f"{take_id}: how far contacts moved apart or together against the source; nearer to 0 "
        "is better, plain forward kinematics is the trivial way.",
    }
    return TopicResult(
        scores=[*kept, *quality_scores(qualities), *gaps, *verdict_scores(qualities)],
        pictures=pictures,
        captions={name: caption for name, caption in captions.items() if name in pictures},
        notes=notes,
        items={"": drifts.items(take_id, source.rate_hz)} if len(drifts.frames) else {},
    )


def _furthest_from_1(scales: np.ndarray) -> float:
    """Return of scales (person,) that of whoever has another size; NaN where somebody's is not uniform.

    >>> _furthest_from_1(np.array([1.0, 0.8, 1.0]))
    0.8
    """
    return float(scales[np.argmax(np.abs(scales - 1.0))])


def _motions(
    store: Store, parts: Sequence[ArtifactRef], tables: Sequence[TableData]
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield scales (P, 22) and motion (T, P, 22, 3) of every variant."""
    for ref, table in zip(parts, tables, strict=True):
        motions = store.read(ref, "variants", columns=["variant_id", "body22_m"])
        for variant_id, scale in zip(table["variant_id"], table["bone_scale"], strict=True):
            bone_scale = scale.reshape(-1, BODY22.num_joints)
            mine = motions["body22_m"][motions["variant_id"] == variant_id].astype(np.float64)
            yield bone_scale, mine.reshape(-1, *bone_scale.shape, 3)


def _extremes(qualities: VariantQualities) -> list[int]:
    """Return the variants to draw: least and greatest scale, and the worst contact drift."""
    scale = np.nan_to_num(qualities.scale, nan=1.0)
    worst = np.nan_to_num(qualities.values["contact_drift_m"], nan=-1.0)
    return sorted({int(np.argmin(scale)), int(np.argmax(scale)), int(np.argmax(worst))})


def _read_variant(store: Store, ref: ArtifactRef, variant_id: str, num_people: int) -> np.ndarray:
    """Read one variant's positions (frame, P, 22, 3) without holding the others."""
    parts = []
    for batch in store.iter_batches(ref, "variants", columns=["variant_id", "body22_m"]):
        parts.append(batch["body22_m"][batch["variant_id"] == variant_id].astype(np.float64))
    return np.concatenate(parts).reshape(-1, num_people, BODY22.num_joints, 3)


TOPIC = Topic(
    name="augmentation",
    heading="Augmentation",
    introduction="The same motion for bodies of other sizes, with contacts kept. The trivial way puts the source's "
    "joint angles on the new bones, so that hands miss each other.",
    reads=("variants", "variant_quality", "poses"),
    plan=_plan,
    run=_run,
    criteria=(Criterion("contact_drift_mean", "contact drift", "m", "variants", ("interaction_mesh",)),),
)
