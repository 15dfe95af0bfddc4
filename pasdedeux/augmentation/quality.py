"""Quality of a variant, as a whole and frame by frame: figures against the source, and verdicts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pasdedeux.arrays import Array, Flags, Integers
from pasdedeux.augmentation.source import Source, points_of
from pasdedeux.augmentation.support import stance_weights
from pasdedeux.figure import Limits, complaints, figure, figures_of, limits_of
from pasdedeux.interaction.known_contacts import UserContact
from pasdedeux.kinematics import bone_lengths
from pasdedeux.plausibility.capsules import capsule_model
from pasdedeux.skeletons import BODY22
from pasdedeux.verdict import Level, Verdict

_STANDS = 0.5
"""A joint stands where its fading stance weight is above this."""
_PERCENTILE = 95.0
_STILL_M = 1e-9
"""A source with less jerk than this, in metres of third difference, is still."""
_SPINE = BODY22.indices(["pelvis", "spine1", "spine2", "spine3", "neck", "head"])


@dataclass(frozen=True)
class Quality:
    """Figures of one variant, columns of `variant_quality`; a variant that fails is not trained on.

    Contact drifts are means of the change of distance of the surfaces over contacts of the source.  Warnings begin
    above the values of converged variants of well captured takes; failures where an error is visible: a hand in the air
    or in the flesh by half of its thickness, bodies apart by a jacket, a sliding foot.
    """

    num_contact_pairs: int = figure("Number of contact points in the source, summed over frames")
    bone_error_m: float = figure("Largest deviation of a bone from its target length", (1e-6, 1e-4))
    contact_drift_m: float = figure(
        "Mean change of the surface distance of contacts against the source; NaN without contacts", better="smaller"
    )
    contact_drift_fk_m: float = figure("Contact drift of plain forward kinematics with the new lengths (the baseline)")
    contact_drift_extremity_m: float | None = figure(
        "Contact drift between two hands or feet; null without such a contact", (0.005, 0.02)
    )
    contact_drift_mixed_m: float | None = figure(
        "Contact drift between a hand or foot and another part of a body; null without such a contact",
        (0.005, 0.02),
    )
    contact_drift_body_m: float | None = figure(
        "Contact drift between other parts of bodies; null without such a contact", (0.01, 0.04)
    )
    laplacian_error_m: float = figure("Root mean square Laplacian residual", better="smaller", words="Laplacian error")
    contact_drift_p95_m: float | None = figure(
        "95th percentile of the change of the surface distance over all contacts; null without contacts",
        (0.015, 0.05),  # no contact may be lost for a while
    )
    stance_excursion_m: float = figure(
        "Largest distance of a standing joint from its median place in that stance, beyond the movement "
        "of the source and that movement times the largest bone change of this person",
        (0.01, 0.03),  # a third of a foot's width
    )
    floor_penetration_m: float = figure(
        "Largest depth of a joint under the floor, beyond that in the source", (0.02, 0.06)
    )
    penetration_m: float = figure(
        "95th percentile over frames of the capsule penetration between people, beyond that in the source",
        (0.01, 0.1),
    )
    self_penetration_m: float | None = figure(
        (
            "95th percentile over frames of the capsule penetration within each person, beyond the source and "
            "beyond plain forward kinematics with the new lengths"
        ),
        (0.05, 0.2),
    )
    spine_bend_rad: float | None = figure(
        "95th percentile over frames of the largest change of an angle between spine bones against the source",
        (0.6, 1.2),
    )
    jerk_ratio: float = figure("Root mean square jerk relative to the source", (1.2, 2.0), better="nearer to 1")

    def judge(self, limits: Limits, *, is_alone: bool = False) -> Verdict:
        """Return the verdict with its reasons, and contact drift compared with plain forward kinematics.

        Without a contact in the source, nothing shows that contacts are kept: at best a warning, except for one person.
        """
        complained = [(level, words) for _, level, words in complaints(self, FIGURES, limits)]
        if not self.num_contact_pairs and not is_alone:
            complained.insert(0, (Level.WARN, "nothing is in contact in the source, so contact drift is not known"))
        return Verdict(
            max((level for level, _ in complained), key=lambda level: level.rank, default=Level.PASS),
            "; ".join(words for _, words in complained),
            figure=FIGURES["contact_drift_m"].words,
            value=self.contact_drift_m,
            unit="m",
            baseline=self.contact_drift_fk_m,
            baseline_name="plain forward kinematics",
            thing="variants",
        )


FIGURES = figures_of(Quality)


@dataclass(frozen=True)
class FrameQuality:
    """Figures of each frame of one variant, arrays (T,), columns of `variant_frames`; meanings default to `Quality`.

    Limits are wider than those of a variant, which are of means and percentiles of them.
    """

    num_contact_pairs: Integers = figure("Number of contact points in the source")
    bone_error_m: Array = figure()
    contact_drift_m: Array = figure(
        "Mean change of the distance of the surfaces of contacts; NaN without one", (0.02, 0.06)
    )
    laplacian_error_m: Array = figure()
    stance_excursion_m: Array = figure()
    floor_penetration_m: Array = figure()
    penetration_m: Array = figure("Capsule penetration between the two people, beyond that in the source", (0.02, 0.12))
    self_penetration_m: Array = figure(
        "The same within each person, beyond the source's and plain forward kinematics', summed"
    )
    spine_bend_rad: Array = figure("Largest change of an angle between spine bones against the source", (0.8, 1.4))
    jerk_ratio: Array = figure(
        "Root mean square jerk over the greater of the source's there and over the take", (2.0, 5.0)
    )

    def judge(self, limits: Limits) -> Integers:
        """Return the verdict of each frame (T,): 0 pass, 1 warn, 2 fail; a figure that is NaN passes."""
        verdicts = np.zeros(len(self.jerk_ratio), dtype=np.int64)
        for name, both in limits.items():
            verdicts = np.maximum(verdicts, FRAME_FIGURES[name].num_past(getattr(self, name), both))
        return verdicts


FRAME_FIGURES = figures_of(FrameQuality, FIGURES)
FRAME_LIMITS = limits_of(FRAME_FIGURES)


class QualityMeter:
    """Measures variants of one take; the source is measured once."""

    def __init__(self, source: Source, user_contacts: Sequence[UserContact] = ()) -> None:
        points = points_of(source.positions_m)
        self._num_frames = len(points)
        self._source = source
        self._contacts = source.contacts(user_contacts)
        self._held = np.nonzero(self._contacts.is_held)
        self._frames = self._held[0]
        self._class = self._contacts.num_hands[self._held]
        self._distance = self._contacts.held_distances(points)
        self._jerk, self._frame_jerk = _jerk(points)
        self._points = points
        self._stances = _stances(stance_weights(source, user_contacts).reshape(len(points), -1) >= _STANDS)
        self._floor = source.floor_m
        self._below = np.maximum(self._floor - points[..., 1], 0.0)
        self._model = capsule_model(BODY22)
        self._penetration = self._penetrate(points)
        self._bends = _spine_bends(points)

    @property
    def has_stances(self) -> bool:
        """Whether any joint stands on the floor in any frame."""
        return bool(self._stances)

    def measure(
        self, points: Array, *, reference: Array, bone_scale: Array, lengths_m: Array, squared_residual: Array
    ) -> tuple[Quality, FrameQuality]:
        """Return the figures of a variant, as a whole and of each frame.

        Args:
            points: Positions (T, n, 3), metres.
            reference: Plain forward kinematics (T, n, 3), metres.
            bone_scale: Scales (P, 22).
            lengths_m: Bone lengths (n,), metres.
            squared_residual: Mean squared Laplacian residual of each frame (T,), square metres.
        """
        drift = np.abs(self._contacts.held_distances(points) - self._distance)
        drift_fk = np.abs(self._contacts.held_distances(reference) - self._distance)
        people = self._people(points)
        bone_error = np.abs(bone_lengths(BODY22, people) - lengths_m.reshape(bone_scale.shape)).max(axis=(1, 2))
        excursion, by_stance = self._excursions(points, np.abs(bone_scale - 1.0).max(axis=1))
        below = np.maximum(self._floor - points[..., 1], 0.0)
        depths = self._penetrate(points)
        extra = np.maximum(depths[:, -1] - self._penetration[:, -1], 0.0)
        by_proportions = self._penetrate(reference, is_within=True)
        within = (depths - np.maximum(self._penetration, by_proportions))[:, :-1].sum(axis=-1)
        within = np.maximum(within, 0.0)
        bends = np.abs(_spine_bends(points) - self._bends).max(axis=1)
        jerk, frame_jerk = _jerk(points)
        pairs = np.bincount(self._frames, minlength=self._num_frames)
        summed = np.bincount(self._frames, weights=drift, minlength=self._num_frames)
        still = np.maximum(self._frame_jerk, self._jerk)
        frames = FrameQuality(
            num_contact_pairs=pairs,
            bone_error_m=bone_error,
            contact_drift_m=np.where(pairs > 0, summed / np.maximum(pairs, 1), np.nan),
            laplacian_error_m=np.sqrt(squared_residual),
            stance_excursion_m=excursion,
            floor_penetration_m=(below - self._below).max(axis=1),
            penetration_m=extra,
            self_penetration_m=within,
            spine_bend_rad=bends,
            jerk_ratio=np.where(still > _STILL_M, frame_jerk / np.maximum(still, _STILL_M), 1.0 + frame_jerk),
        )
        quality = Quality(
            num_contact_pairs=len(drift),
            bone_error_m=float(bone_error.max()),
            contact_drift_m=float(drift.mean()) if len(drift) else math.nan,
            contact_drift_fk_m=float(drift_fk.mean()) if len(drift) else math.nan,
            contact_drift_extremity_m=_mean(drift[self._class == 2]),
            contact_drift_mixed_m=_mean(drift[self._class == 1]),
            contact_drift_body_m=_mean(drift[self._class == 0]),
            contact_drift_p95_m=float(np.percentile(drift, _PERCENTILE)) if len(drift) else None,
            laplacian_error_m=float(np.sqrt(squared_residual.mean())),
            stance_excursion_m=max(by_stance, default=0.0),
            floor_penetration_m=float(frames.floor_penetration_m.max()),
            penetration_m=float(np.percentile(extra, _PERCENTILE)),
            self_penetration_m=float(np.percentile(within, _PERCENTILE)),
            spine_bend_rad=float(np.percentile(bends, _PERCENTILE)),
            # A source without jerk (a still clip) has no ratio: 1 when the variant is still too.
            jerk_ratio=jerk / self._jerk if self._jerk > _STILL_M else 1.0 + jerk,
        )
        return quality, frames

    def worst_contact(self, points: Array) -> tuple[float, tuple[int, int]] | None:
        """Return the largest drift of the contact of two bones, and these bones; None without a contact.

        The drift is the 95th percentile of the change of distance of the surfaces, metres, over the frames in which the
        two are in contact; bones are numbered through all people, by the joint that each ends in.  So a contact that is
        lost for a while is not averaged out by others.
        """
        if not len(self._frames):
            return None
        drift = np.abs(self._contacts.held_distances(points) - self._distance)
        both, which = np.unique(np.sort(self._contacts.bones()[self._held], axis=1), axis=0, return_inverse=True)
        drifts = [float(np.percentile(drift[which == number], _PERCENTILE)) for number in range(len(both))]
        worst = int(np.argmax(drifts))
        return drifts[worst], (int(both[worst, 0]), int(both[worst, 1]))

    def _people(self, points: Array) -> Array:
        return points.reshape(-1, *self._source.positions_m.shape[1:])

    def _excursions(self, points: Array, rescaled: Array) -> tuple[Array, list[float]]:
        """Return the distance of standing joints from their median place in the stance: by frame, by stance.

        Movement of the source during the stance is subtracted, also scaled by the change of the person's bones: a foot
        that turns is judged at its pivot, because its other joints move on a smaller or larger circle.  Nothing is
        subtracted if the person's bones keep their lengths, or if the source does not move.

        Args:
            points: Positions (T, n, 3), metres.
            rescaled: The part of their length that bones of each person gain or lose at most (P,).
        """
        frames, worst = np.zeros(self._num_frames), []
        for joint, when in self._stances:
            source, variant = self._points[when, joint][:, [0, 2]], points[when, joint][:, [0, 2]]
            moved, travel = (_from_median(places) for places in (variant - source, source))
            away = np.maximum(moved - rescaled[joint // BODY22.num_joints] * travel.max(), 0.0)
            frames[when] = np.maximum(frames[when], away)
            worst.append(float(away.max()))
        return frames, worst

    def _penetrate(self, points: Array, *, is_within: bool = False) -> Array:
        model = replace(self._model, between=self._model.between[:0]) if is_within else self._model
        return model.penetration(self._people(points), self._source.radii_m)


def _from_median(places: Array) -> Array:
    """Return how far places (T, 2) are from their median (T,)."""
    return np.asarray(np.linalg.norm(places - np.median(places, axis=0), axis=-1))


def _jerk(points: Array) -> tuple[float, Array]:
    """Return the root mean square third difference of points (T, n, 3), metres: of all frames, and of each (T,).

    Ends repeat; 0 below 4 frames.
    """
    if len(points) < 4:
        return 0.0, np.zeros(len(points))
    squared = (np.diff(points, n=3, axis=0) ** 2).sum(axis=-1).mean(axis=-1)
    return float(np.sqrt(squared.mean())), np.pad(np.sqrt(squared), (1, 2), mode="edge")


def _stances(stands: Flags) -> list[tuple[int, slice]]:
    """Return joint and frames of every stance from flags of standing joints (T, n)."""
    edges = np.diff(np.pad(stands, ((1, 1), (0, 0))).astype(np.int8), axis=0)
    stances = []
    for joint in np.flatnonzero(stands.any(axis=0)):
        starts, stops = (np.flatnonzero(edges[:, joint] == sign) for sign in (1, -1))
        stances += [(int(joint), slice(int(a), int(b))) for a, b in zip(starts, stops, strict=True)]
    return stances


def _spine_bends(points: Array) -> Array:
    """Return the angle between neighbouring spine bones (frame, 4 P), radians."""
    spines = np.arange(0, points.shape[1], BODY22.num_joints)[:, None] + _SPINE
    vectors = np.diff(points[:, spines], axis=2)
    units = vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-9)
    cosines = (units[:, :, 1:] * units[:, :, :-1]).sum(axis=-1)
    return np.asarray(np.arccos(np.clip(cosines, -1.0, 1.0)).reshape(len(points), -1))


def _mean(values: Array | Sequence[float]) -> float | None:
    return float(np.mean(values)) if len(values) else None
