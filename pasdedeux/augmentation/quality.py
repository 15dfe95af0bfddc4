"""How good a variant is: every figure is against the source, and a verdict says which ones are not good enough."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt

from pasdedeux.augmentation.contacts import FEET, ContactSettings, contact_class, stance_weights
from pasdedeux.augmentation.source import NUM_POINTS, Source
from pasdedeux.errors import InputError
from pasdedeux.kinematics import bone_lengths
from pasdedeux.plausibility import body_height_m, capsule_model, clip_penetration
from pasdedeux.skeletons import BODY22

__all__ = ["CONTACT_M", "Judge", "Limit", "Quality", "QualityLimits", "Verdict", "root_mean_square_jerk"]

Array = npt.NDArray[np.float64]

CONTACT_M = 0.2
"""Joints of two people closer than this in the source are in contact (DESIGN.md section 6)."""

_STANDS = 0.5
"""A foot joint stands where its fading stance weight is above this."""
_PERCENTILE = 95.0
_SPINE = BODY22.indices(["pelvis", "spine1", "spine2", "spine3", "neck", "head"])
_SPINES = np.array([_SPINE, [joint + BODY22.num_joints for joint in _SPINE]])


@dataclass(frozen=True)
class Limit:
    """From where on a figure is a warning, and from where on a failure."""

    warn: float
    fail: float

    def __post_init__(self) -> None:
        """Check the order."""
        if not 0 <= self.warn <= self.fail:
            raise InputError(f"limit warn {self.warn:g}, fail {self.fail:g}: allowed is 0 <= warn <= fail")


@dataclass(frozen=True)
class QualityLimits:
    """Limits of the figures; the ratio of jerks has no unit."""

    bone_error_m: Limit = Limit(1e-6, 1e-4)
    contact_drift_extremity_m: Limit = Limit(0.005, 0.02)
    contact_drift_body_m: Limit = Limit(0.02, 0.06)
    foot_slide_m: Limit = Limit(0.001, 0.005)
    floor_penetration_m: Limit = Limit(0.02, 0.06)
    penetration_m: Limit = Limit(0.01, 0.1)
    spine_bend_rad: Limit = Limit(0.6, 1.2)
    jerk_ratio: Limit = Limit(1.2, 2.0)


class Verdict:
    """The three verdicts."""

    PASS = "pass"
    WARN = "warn"
    FAIL = "fail"


@dataclass(frozen=True)
class Quality:
    """Figures of one variant; columns of `variant_quality` bear the same names.

    Contact drifts are means of the change of distance over joint pairs closer than 0.2 m in the source: over all of
    them, over pairs of two hands or feet, over pairs of one, and over body on body; None where there is no such pair.
    """

    num_contact_pairs: int
    bone_error_m: float
    contact_drift_m: float
    contact_drift_fk_m: float
    contact_drift_extremity_m: float | None
    contact_drift_mixed_m: float | None
    contact_drift_body_m: float | None
    laplacian_error_m: float
    foot_slide_m: float
    floor_penetration_m: float
    penetration_m: float
    self_penetration_m: float
    spine_bend_rad: float
    jerk_ratio: float

    def judge(self, limits: QualityLimits) -> tuple[str, str]:
        """Give the verdict and what was not passed, in words."""
        verdict, reasons = Verdict.PASS, []
        for field in fields(limits):
            value, limit = getattr(self, field.name), getattr(limits, field.name)
            if value is None or value <= limit.warn:
                continue
            is_failed = value > limit.fail
            bound = limit.fail if is_failed else limit.warn
            verdict = Verdict.FAIL if is_failed or verdict == Verdict.FAIL else Verdict.WARN
            reasons.append(f"{field.name} {value:.3g} is above {bound:g}")
        return verdict, "; ".join(reasons)


class Judge:
    """Measures variants of one take; what belongs to the source is measured once."""

    def __init__(self, source: Source, contacts: ContactSettings) -> None:
        points = source.positions_m.reshape(-1, NUM_POINTS, 3)
        half = BODY22.num_joints
        squared = ((points[:, :half, None] - points[:, None, half:]) ** 2).sum(axis=-1)
        self._frames, self._first, self._second = np.nonzero(squared < CONTACT_M**2)
        self._class = contact_class()[self._first, self._second]
        self._distance = np.sqrt(squared[self._frames, self._first, self._second])
        self._jerk = root_mean_square_jerk(points)
        self._feet = np.array([foot + offset for offset in (0, half) for foot in FEET])
        standing = stance_weights(source, contacts)
        self._stands = np.sqrt(standing[1:] * standing[:-1]).reshape(len(standing) - 1, len(self._feet)) > _STANDS
        self._slide = self._foot_steps(points)
        floor = np.repeat(source.floor_m, half)
        self._floor = floor
        self._below = np.maximum(floor - points[..., 1], 0.0)
        self._model = capsule_model(BODY22)
        self._radii = self._model.radii_m(body_height_m(BODY22, source.lengths_m))
        self._penetration = self._penetrate(points)
        self._bends = _spine_bends(points)

    def measure(self, points: Array, *, reference: Array, lengths_m: Array, laplacian_error_m: float) -> Quality:
        """Measure a variant: positions and plain forward kinematics (T, 44, 3), lengths (44,), metres."""
        drift = np.abs(self._contact_distances(points) - self._distance)
        drift_fk = np.abs(self._contact_distances(reference) - self._distance)
        pair = points.reshape(-1, 2, BODY22.num_joints, 3)
        bone_error = np.abs(bone_lengths(BODY22, pair) - lengths_m.reshape(2, -1)).max()
        slide = np.maximum(self._foot_steps(points) - self._slide, 0.0)[self._stands]
        below = np.maximum(self._floor - points[..., 1], 0.0)
        depths = self._penetrate(points)
        extra = depths - self._penetration
        by_proportions = self._penetrate(reference, is_within=True)
        within = (depths - np.maximum(self._penetration, by_proportions))[:, :2].sum(axis=-1)
        jerk = root_mean_square_jerk(points)
        return Quality(
            num_contact_pairs=len(drift),
            bone_error_m=float(bone_error),
            contact_drift_m=_mean(drift) or 0.0,
            contact_drift_fk_m=_mean(drift_fk) or 0.0,
            contact_drift_extremity_m=_mean(drift[self._class == 2]),
            contact_drift_mixed_m=_mean(drift[self._class == 1]),
            contact_drift_body_m=_mean(drift[self._class == 0]),
            laplacian_error_m=laplacian_error_m,
            foot_slide_m=_mean(slide) or 0.0,
            floor_penetration_m=float((below - self._below).max()),
            penetration_m=float(np.percentile(np.maximum(extra[:, 2], 0.0), _PERCENTILE)),
            self_penetration_m=float(np.percentile(np.maximum(within, 0.0), _PERCENTILE)),
            spine_bend_rad=float(np.percentile(np.abs(_spine_bends(points) - self._bends).max(axis=1), _PERCENTILE)),
            # A source without jerk (a still clip) has no ratio: 1 when the variant is still too.
            jerk_ratio=jerk / self._jerk if self._jerk > 1e-9 else 1.0 + jerk,
        )

    def _contact_distances(self, points: Array) -> Array:
        apart = points[self._frames, self._first] - points[self._frames, self._second + BODY22.num_joints]
        return np.asarray(np.sqrt((apart**2).sum(axis=-1)))

    def _foot_steps(self, points: Array) -> Array:
        return np.asarray(np.linalg.norm(np.diff(points[:, self._feet], axis=0)[..., [0, 2]], axis=-1))

    def _penetrate(self, points: Array, *, is_within: bool = False) -> Array:
        pairs = np.ascontiguousarray(points.reshape(-1, 2, BODY22.num_joints, 3))
        model = self._model
        between = model.between[:0] if is_within else model.between
        return np.asarray(clip_penetration(pairs, self._radii, model.parents, model.within, between))


def root_mean_square_jerk(points: Array) -> float:
    """Give the root mean square third difference over frames of points (frame, n, 3), metres; 0 below 4 frames."""
    if len(points) < 4:
        return 0.0
    return float(np.sqrt((np.diff(points, n=3, axis=0) ** 2).sum(axis=-1).mean()))


def _spine_bends(points: Array) -> Array:
    """Give the angle between neighbouring spine bones (frame, 8), radians, both people."""
    vectors = np.diff(points[:, _SPINES], axis=2)
    units = vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-9)
    cosines = (units[:, :, 1:] * units[:, :, :-1]).sum(axis=-1)
    return np.asarray(np.arccos(np.clip(cosines, -1.0, 1.0)).reshape(len(points), -1))


def _mean(values: Array | Sequence[float]) -> float | None:
    return float(np.mean(values)) if len(values) else None
