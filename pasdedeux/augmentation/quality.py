"""How good a variant is, as a whole and frame by frame: every figure is against the source, and verdicts judge them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from pasdedeux.augmentation.source import Source, points_of
from pasdedeux.augmentation.support import stance_weights
from pasdedeux.interaction.known_contacts import UserContact
from pasdedeux.kinematics import bone_lengths
from pasdedeux.plausibility import capsule_model
from pasdedeux.skeletons import BODY22
from pasdedeux.verdict import Level, Verdict

__all__ = ["FRAME_LIMITS", "LIMITS", "FrameQuality", "Limits", "Measured", "Quality", "QualityMeter"]

Array = npt.NDArray[np.float64]

_STANDS = 0.5
"""A joint stands where its fading stance weight is above this."""
_PERCENTILE = 95.0
_SHOWN = {"m": (" mm", 1e3), "rad": (" rad", 1.0)}
"""Units of figures by the ending of their name, as reasons say them."""
_STILL_M = 1e-9
"""A source with less jerk than this, in metres of third difference, is still."""
_SPINE = BODY22.indices(["pelvis", "spine1", "spine2", "spine3", "neck", "head"])


Limits = Mapping[str, tuple[float, float]]
"""By figure: above the first it is a warning, above the second a failure."""

LIMITS: Limits = {
    "bone_error_m": (1e-6, 1e-4),
    "contact_drift_extremity_m": (0.005, 0.02),
    "contact_drift_mixed_m": (0.005, 0.02),
    "contact_drift_body_m": (0.01, 0.04),
    "contact_drift_p95_m": (0.015, 0.05),  # no contact may be lost for a while
    "stance_excursion_m": (0.01, 0.03),  # a third of a foot's width
    "floor_penetration_m": (0.02, 0.06),
    "penetration_m": (0.01, 0.1),
    "self_penetration_m": (0.05, 0.2),
    "spine_bend_rad": (0.6, 1.2),
    "jerk_ratio": (1.2, 2.0),
}
"""Limits of the figures of a variant; one that fails is nothing to train on.

Warnings begin at what converged variants of well captured takes keep to; failures where an eye sees that something is
wrong: a hand in the air or in the flesh by half of its thickness, bodies apart by a jacket, a foot that slides.
"""

FRAME_LIMITS: Limits = {
    "bone_error_m": (1e-6, 1e-4),
    "contact_drift_m": (0.02, 0.06),
    "stance_excursion_m": (0.01, 0.03),
    "floor_penetration_m": (0.02, 0.06),
    "penetration_m": (0.02, 0.12),
    "self_penetration_m": (0.05, 0.2),
    "spine_bend_rad": (0.8, 1.4),
    "jerk_ratio": (2.0, 5.0),
}
"""Limits of the figures of one frame: wider than those of a variant, which are means and percentiles of them."""


@dataclass(frozen=True)
class Quality:
    """Figures of one variant; columns of `variant_quality` bear the same names.

    Contact drifts are means of the change of distance of the surfaces over contacts of the source: over all of them
    (NaN without any), over those of two hands or feet, of one, and of body on body; None where there is no such one.
    """

    num_contact_pairs: int
    bone_error_m: float
    contact_drift_m: float
    contact_drift_fk_m: float
    contact_drift_extremity_m: float | None
    contact_drift_mixed_m: float | None
    contact_drift_body_m: float | None
    contact_drift_p95_m: float | None
    laplacian_error_m: float
    stance_excursion_m: float
    floor_penetration_m: float
    penetration_m: float
    self_penetration_m: float
    spine_bend_rad: float
    jerk_ratio: float

    def judge(self, limits: Limits, *, is_alone: bool = False) -> Verdict:
        """Return the verdict, with what was not passed in words, and contact drift beside plain forward kinematics'.

        Without a contact in the source, nothing shows that contacts are kept: at best a warning, but for who is alone.
        """
        level, reasons = Level.PASS, []
        if not self.num_contact_pairs and not is_alone:
            level, reasons = Level.WARN, ["nothing is in contact in the source, so contact drift is not known"]
        for name, (warn, fail) in limits.items():
            value = getattr(self, name)
            if value is None or value <= warn:
                continue
            is_failed = value > fail
            level = Level.FAIL if is_failed or level is Level.FAIL else Level.WARN
            base, _, ending = name.rpartition("_")
            unit, factor = _SHOWN.get(ending, ("", 1.0))
            words = (base if unit else name).replace("_", " ")
            limit = factor * (fail if is_failed else warn)
            reasons.append(f"{words} {factor * value:.3g}{unit} is above {limit:.3g}{unit}")
        return Verdict(
            level,
            "; ".join(reasons),
            figure="contact drift",
            value=self.contact_drift_m,
            unit="m",
            baseline=self.contact_drift_fk_m,
            baseline_name="plain forward kinematics",
            thing="variants",
        )


@dataclass(frozen=True)
class FrameQuality:
    """Figures of each frame of one variant, arrays (T,); columns of `variant_frames` bear and explain the same names.

    Contact drift is over the frame's contacts in the source; NaN where there are none.
    """

    num_contact_pairs: npt.NDArray[np.int64]
    bone_error_m: Array
    contact_drift_m: Array
    laplacian_error_m: Array
    stance_excursion_m: Array
    floor_penetration_m: Array
    penetration_m: Array
    self_penetration_m: Array
    spine_bend_rad: Array
    jerk_ratio: Array

    def judge(self, limits: Limits) -> npt.NDArray[np.int64]:
        """Return the verdict of each frame (T,): 0 pass, 1 warn, 2 fail; a figure that is NaN passes."""
        verdicts = np.zeros(len(self.jerk_ratio), dtype=np.int64)
        for name, (warn, fail) in limits.items():
            values = getattr(self, name)
            verdicts = np.maximum(verdicts, (values > warn).astype(np.int64) + (values > fail))
        return verdicts


@dataclass(frozen=True)
class Measured:
    """Figures of one variant, as a whole and of each frame."""

    quality: Quality
    frames: FrameQuality


class QualityMeter:
    """Measures variants of one take; what belongs to the source is measured once."""

    def __init__(
        self,
        source: Source,
        *,
        user_contacts: Sequence[UserContact] = (),
    ) -> None:
        points = points_of(source.positions_m)
        self._num_frames = len(points)
        self._source = source
        self._contacts = source.contacts(user_contacts)
        self._held = np.nonzero(self._contacts.is_held)
        self._frames = self._held[0]
        self._class = self._contacts.num_hands[self._held]
        self._distance = self._contact_distances(points)
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
        """Whether anything ever stands on the floor."""
        return bool(self._stances)

    def measure(
        self, points: Array, *, reference: Array, bone_scale: Array, lengths_m: Array, squared_residual: Array
    ) -> Measured:
        """Measure a variant.

        Args:
            points: Positions (T, n, 3), metres.
            reference: Plain forward kinematics (T, n, 3), metres.
            bone_scale: Scales (P, 22).
            lengths_m: Bone lengths (n,), metres.
            squared_residual: Mean squared Laplacian residual of each frame (T,), square metres.
        """
        drift = np.abs(self._contact_distances(points) - self._distance)
        drift_fk = np.abs(self._contact_distances(reference) - self._distance)
        people = self._people(points)
        bone_error = np.abs(bone_lengths(BODY22, people) - lengths_m.reshape(bone_scale.shape)).max(axis=(1, 2))
        excursion, by_stance = self._excursions(points)
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
        return Measured(quality=quality, frames=frames)

    def _people(self, points: Array) -> Array:
        return points.reshape(-1, *self._source.positions_m.shape[1:])

    def _contact_distances(self, points: Array) -> Array:
        return np.asarray(np.linalg.norm(self._contacts.vectors(points)[self._held], axis=-1))

    def _excursions(self, points: Array) -> tuple[Array, list[float]]:
        """Return how far joints that stand are from their median place in that stance: by frame, by stance.

        Movement of the source while it stands is not counted.
        """
        moved = (points - self._points)[..., [0, 2]]
        frames, worst = np.zeros(self._num_frames), []
        for joint, when in self._stances:
            places = moved[when, joint]
            away = np.linalg.norm(places - np.median(places, axis=0), axis=-1)
            frames[when] = np.maximum(frames[when], away)
            worst.append(float(away.max()))
        return frames, worst

    def _penetrate(self, points: Array, *, is_within: bool = False) -> Array:
        model = replace(self._model, between=self._model.between[:0]) if is_within else self._model
        return model.penetration(self._people(points), self._source.radii_m)


def _jerk(points: Array) -> tuple[float, Array]:
    """Return the root mean square third difference of points (T, n, 3), metres: of all frames, and of each (T,).

    Ends repeat; 0 below 4 frames.
    """
    if len(points) < 4:
        return 0.0, np.zeros(len(points))
    squared = (np.diff(points, n=3, axis=0) ** 2).sum(axis=-1).mean(axis=-1)
    return float(np.sqrt(squared.mean())), np.pad(np.sqrt(squared), (1, 2), mode="edge")


def _stances(stands: npt.NDArray[np.bool_]) -> list[tuple[int, slice]]:
    """Return joint and frames of every stance, of which joints stand when (T, n)."""
    edges = np.diff(np.pad(stands, ((1, 1), (0, 0))).astype(np.int8), axis=0)
    found = []
    for joint in np.flatnonzero(stands.any(axis=0)):
        starts, stops = (np.flatnonzero(edges[:, joint] == sign) for sign in (1, -1))
        found += [(int(joint), slice(int(a), int(b))) for a, b in zip(starts, stops, strict=True)]
    return found


def _spine_bends(points: Array) -> Array:
    """Return the angle between neighbouring spine bones (frame, 4 P), radians."""
    spines = np.arange(0, points.shape[1], BODY22.num_joints)[:, None] + _SPINE
    vectors = np.diff(points[:, spines], axis=2)
    units = vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-9)
    cosines = (units[:, :, 1:] * units[:, :, :-1]).sum(axis=-1)
    return np.asarray(np.arccos(np.clip(cosines, -1.0, 1.0)).reshape(len(points), -1))


def _mean(values: Array | Sequence[float]) -> float | None:
    return float(np.mean(values)) if len(values) else None
