"""Quality of augmentation: figures over scales beside plain forward kinematics, and pictures beside the source."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array
from pasdedeux.augmentation.augment import Augmenter
from pasdedeux.augmentation.quality import FIGURES
from pasdedeux.augmentation.settings import AugmentationSettings
from pasdedeux.augmentation.source import Source, points_of, reference_motion
from pasdedeux.augmentation.variations import Variation
from pasdedeux.evaluation.figures import Curve, curve_figure
from pasdedeux.evaluation.players import pack_player, people_panel, shown_frames
from pasdedeux.evaluation.scores import Score, scores_of
from pasdedeux.evaluation.verdicts import Items
from pasdedeux.interaction.contacts import Contacts
from pasdedeux.interaction.known_contacts import UserContact
from pasdedeux.skeletons import BODY22
from pasdedeux.spread import evenly_spread

_MAX_LINKS = 10
"""Contacts drawn in a frame, at most."""
QUALITY_COLUMNS = {
    "estimated_gap_m": "m",
    **{name: one.unit for name, one in FIGURES.items() if one.kind == "float" and name != "contact_drift_fk_m"},
}
"""Columns of a variant's quality that are scored, with their units."""


_SAMPLE_S = 1.0
"""Seconds in the middle of a take that the guaranteed solver does too."""
_SAMPLE_VARIANTS = 2
"""Variants of a take that it does, evenly spread."""


@dataclass(frozen=True)
class VariantQualities:
    """Quality of the variants of one take.

    Args:
        take_id: Name of the take.
        scale: Uniform scale of whoever is scaled, (variant,); NaN where not uniform.
        values: Quality columns by name, each (variant,).
        drift_fk_m: Contact drift of plain forward kinematics, (variant,), metres: the baseline.
        verdicts: pass, warn or fail of each variant.
    """

    take_id: str
    scale: Array
    values: Mapping[str, Array]
    drift_fk_m: Array
    verdicts: Sequence[str]


def quality_scores(qualities: VariantQualities) -> list[Score]:
    """Return mean and worst of every quality column over the variants of a take, contact drift beside its baseline."""
    scores = []
    columns = [(name, "interaction_mesh", values, False) for name, values in qualities.values.items()]
    columns.append(("contact_drift_m", "naive_fk", qualities.drift_fk_m, True))
    for name, method, values, is_baseline in columns:
        finite = values[np.isfinite(values)]
        if not len(finite):
            continue
        metric = name.removesuffix("_m")
        figures = {f"{metric}_mean": finite.mean(), f"{metric}_worst": finite.max()}
        more = {"is_baseline": is_baseline, "item": qualities.take_id, "count": len(finite)}
        scores += scores_of(figures, method, QUALITY_COLUMNS[name], **more)
    return scores


@dataclass(frozen=True)
class ContactDrifts:
    """How far contacts of variants come from their distance, metres.

    Args:
        is_hand: Whether a contact is of hands or feet, (contact,); one for each frame that it is held in.
        frames: That frame, (contact,).
        found_m: By method, the drifts of each variant (variant, contact).
    """

    is_hand: npt.NDArray[np.bool_]
    frames: npt.NDArray[np.int64]
    found_m: Mapping[str, Array]

    def items(self, take_id: str, rate_hz: float) -> Items:
        """Return the drift of each contact in each frame of each variant."""
        count = len(self.found_m["naive_fk"])
        values = {method: drifts.ravel() for method, drifts in self.found_m.items()}
        times_s = np.tile(self.frames / rate_hz, count)
        return Items(values, [take_id] * len(times_s), times_s, ("naive_fk",), count)


def contact_drifts(contacts: Contacts, source: Source, variants: Iterable[tuple[Array, Array]]) -> ContactDrifts:
    """Return how far contacts of hands and feet, and of bodies, come from their distance, beside plain FK.

    Args:
        contacts: Those of the take: known ones where it has such, otherwise those found.
        source: The take.
        variants: Scales (P, 22) and motion (T, P, 22, 3) of each.
    """
    held = np.nonzero(contacts.is_held)
    is_hand = contacts.num_hands[held] > 0

    def distances(points: Array) -> Array:
        return np.asarray(np.linalg.norm(contacts.vectors(points)[held], axis=-1))

    before = distances(points_of(source.positions_m))
    found: dict[str, list[Array]] = {"interaction_mesh": [], "naive_fk": []}
    for scale, motion in variants:
        plain = reference_motion(source, scale[None])[0]
        for method, moved in zip(found, (motion, plain), strict=True):
            found[method].append(np.abs(distances(points_of(moved)) - before))
    drifts = {method: np.array(rows).reshape(len(rows), len(is_hand)) for method, rows in found.items()}
    return ContactDrifts(is_hand, held[0], drifts)


def contact_scores(drifts: ContactDrifts, *, item: str) -> list[Score]:
    """Return median, 95th percentile and worst over contacts, frames and variants of a take, of hands and of bodies."""
    scores = []
    for name, is_mine in (("hand", drifts.is_hand), ("body", ~drifts.is_hand)):
        for method, found in drifts.found_m.items():
            mine = found[:, is_mine].ravel()
            if len(mine):
                values = zip(("median", "p95", "worst"), np.percentile(mine, [50.0, 95.0, 100.0]), strict=True)
                figures = {f"{name}_contact_drift_{which}": value for which, value in values}
                scores += scores_of(figures, method, "m", is_baseline=method == "naive_fk", item=item, count=len(mine))
    return scores


def gap_scores(
    source: Source,
    bone_scale: Array,
    settings: AugmentationSettings,
    contacts: Sequence[UserContact] = (),
    *,
    item: str,
) -> list[Score]:
    """Return how far the bulk solver ends from guaranteed descent on a sample, beside its own estimate of that.

    The sample is the second in the middle of the take, for the first and the last variant.

    Args:
        source: The take.
        bone_scale: Scales of its variants (variant, P, 22).
        settings: How variants were solved; whatever the solver was, the sample is of the bulk solver.
        contacts: Contacts stated by the user.
        item: Name of the take.
    """
    middle, half = source.num_frames // 2, max(int(_SAMPLE_S * source.rate_hz / 2.0), 1)
    window = slice(max(middle - half, 0), min(middle + half, source.num_frames))
    within = [contact.within(window.start, window.stop) for contact in contacts]
    user = [contact for contact in within if contact is not None]
    bulk, best = (
        Augmenter(source.take_frames(window), settings.model_copy(update={"solver": solver}), user_contacts=user).solve(
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
        for found, unit in ((figures, "m"), (energies, ""))
        for score in scores_of(found, "interaction_mesh", unit, item=item, count=len(bulk))
    ]


def verdict_scores(qualities: VariantQualities) -> list[Score]:
    """Count the variants that passed, warned and failed."""
    counts = {f"variants_{level}": list(qualities.verdicts).count(level) for level in ("pass", "warn", "fail")}
    return scores_of(counts, "interaction_mesh", item=qualities.take_id, count=len(qualities.verdicts))


def drift_figure(qualities: VariantQualities) -> bytes:
    """Draw contact drift against the scale, ours beside plain forward kinematics; SVG bytes."""
    order = np.argsort(qualities.scale)
    order = order[np.isfinite(qualities.scale[order])]
    scale = qualities.scale[order]
    return curve_figure(
        [
            Curve("interaction mesh", scale, 1e3 * qualities.values["contact_drift_m"][order]),
            Curve("plain forward kinematics", scale, 1e3 * qualities.drift_fk_m[order], is_baseline=True),
        ],
        title=f"{qualities.take_id}: contacts kept",
        x_label="scale of whoever is scaled",
        y_label="mean change of contact distance (mm)",
    )


def variant_player(source: Source, variants_m: Mapping[str, Array]) -> bytes:
    """Show the source and variants side by side with the source's contacts as black lines.

    Args:
        source: The take.
        variants_m: Variants by name, each (frame, P, 22, 3), metres.
    """
    frames, rate_hz = shown_frames(source.num_frames, source.rate_hz)
    contacts = source.contacts()
    held, ends = contacts.is_held[frames], contacts.points[frames].reshape(len(frames), -1, 2, 2)
    shares = np.abs(contacts.shares[frames].reshape(*ends.shape, 1))
    strongest = np.argsort(~held, axis=1, kind="stable")[:, : min(_MAX_LINKS, int(held.sum(axis=1).max(initial=0)))]
    objects = source.objects.ends_m[frames] if source.objects else None
    panels = []
    for name, motion in {"source": source.positions_m, **variants_m}.items():
        joints = motion[frames].reshape(len(frames), -1, 3)
        links = (shares * joints[np.arange(len(frames))[:, None, None, None], ends]).sum(axis=3)
        links[:, :, 1] += contacts.places_m[frames]
        links[~held] = np.nan
        links = np.take_along_axis(links, strongest[:, :, None, None], axis=1)
        panels.append(people_panel(name, BODY22, motion[frames], links, objects))
    return pack_player(panels, rate_hz=rate_hz)
