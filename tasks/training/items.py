"""Variants of a store as items for training and evaluation of models."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pasdedeux.augmentation import AugmentationSettings, Source
from pasdedeux.evaluation.verdicts import Items
from pasdedeux.learning.meter import frame_errors_cm
from pasdedeux.learning.model import TrainingItem, VariantRequest, mapped_item, mapped_source
from pasdedeux.learning.splits import VariantKey
from pasdedeux.skeletons import BODY22, MAPPED_SKELETONS, JointMap
from storage_schema import ArtifactRef, Manifest, Store
from tasks.augmentation import batch_of
from tasks.files.curation import content_columns, rejected_names
from tasks.rows.takes import TakeMotion, read_take, read_variants
from tasks.stage.facts import TakeFacts, VariantFacts


def interaction_of(take: Manifest) -> str:
    """Return the interaction that a take performs: the built-in duet that it was made from, or itself."""
    return str(take.parameters.get("duet", {}).get("name", "") or TakeFacts.of(take).take_id)


def interactions_of(takes: Iterable[Manifest]) -> dict[str, str]:
    """Return the interaction of each take by the take's name."""
    return {TakeFacts.of(take).take_id: interaction_of(take) for take in takes}


def frame_errors(item: TrainingItem, predicted: Mapping[str, np.ndarray]) -> Items:
    """Return the error of each frame of an item's predictions, by model, cm."""
    errors = {name: frame_errors_cm(motion_m, item.motion_m) for name, motion_m in predicted.items()}
    times_s = np.arange(len(item.motion_m)) / item.request.source.rate_hz
    return Items(errors, [item.request.take_id] * len(times_s), times_s, count=1)


@dataclass(frozen=True)
class _Home:
    """Artifact and scales of a variant, and whether it failed."""

    ref: ArtifactRef
    bone_scale: np.ndarray
    is_failed: bool


class StoredVariants:
    """The variants of some artifacts, with their takes: read one at a time, when they are asked for."""

    def __init__(
        self,
        store: Store,
        takes: Sequence[ArtifactRef],
        variants: Sequence[ArtifactRef],
        skeleton: str = BODY22.name,
        *,
        rejected: Mapping[str, str] | None = None,
    ) -> None:
        self._store = store
        self._joints = MAPPED_SKELETONS.get(skeleton)
        self._mapped: dict[str, Source] = {}
        self.takes: dict[str, TakeMotion] = {
            TakeFacts.of(store.manifest(ref)).take_id: read_take(store, ref) for ref in takes
        }
        self._homes: dict[tuple[str, str], _Home] = {}
        for ref in variants:
            take_id = VariantFacts.of(store.manifest(ref)).take_id
            rejected_here = {name: it for name, it in (rejected or {}).items() if name.partition("/")[0] == take_id}
            refused = rejected_names(
                rejected_here, store.iter_batches(ref, "variants", columns=content_columns("variants"))
            )
            table = store.read(ref, "variant_quality", columns=["variant_id", "bone_scale", "verdict"])
            for row, variant_id in enumerate(table["variant_id"]):
                is_refused = str(table["verdict"][row]) == "fail" or f"{take_id}/{variant_id}" in refused
                home = _Home(ref, table["bone_scale"][row].reshape(2, -1), is_refused)
                self._homes[take_id, str(variant_id)] = home

    def sound(self, keys: Sequence[VariantKey]) -> list[VariantKey]:
        """Return the variants that did not fail and are not rejected."""
        return [key for key in keys if not self._homes[key.take_id, key.variant_id].is_failed]

    def sound_names(self, take_id: str) -> list[tuple[str, str]]:
        """Return the variants of a take that did not fail, by take and variant."""
        return [key for key, home in self._homes.items() if key[0] == take_id and not home.is_failed]

    def items(self, wanted: Sequence[tuple[str, str]]) -> Iterator[TrainingItem]:
        """Read variants, named by take and variant, one artifact at a time."""
        by_ref: dict[ArtifactRef, set[str]] = {}
        for take_id, variant_id in wanted:
            by_ref.setdefault(self._homes[take_id, variant_id].ref, set()).add(variant_id)
        for ref, names in by_ref.items():
            manifest = self._store.manifest(ref)
            take_id, batch = VariantFacts.of(manifest).take_id, batch_of(manifest)
            there = self._store.read(ref, "variant_quality", columns=["variant_id"])["variant_id"]
            for name, motion in zip(there, read_variants(self._store, ref), strict=True):
                if str(name) not in names:
                    continue
                request = VariantRequest(
                    take_id=take_id,
                    source=self.takes[take_id].source,
                    bone_scale=self._homes[take_id, str(name)].bone_scale,
                    solving=batch.part(AugmentationSettings),
                    contacts=batch.contacts,
                )
                item = TrainingItem(str(name), request, motion.astype(np.float64))
                yield item if self._joints is None else self._on_other_skeleton(item, self._joints)

    def _on_other_skeleton(self, item: TrainingItem, joints: JointMap) -> TrainingItem:
        take_id = item.request.take_id
        if take_id not in self._mapped:
            self._mapped[take_id] = mapped_source(item.request.source, joints)
        return mapped_item(item, joints, self._mapped[take_id])
