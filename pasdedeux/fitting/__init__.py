"""Fitting: poses fitted to observations with exact bone lengths."""

from pasdedeux.fitting.bones import BoneForest, BoneState
from pasdedeux.fitting.levenberg import FitResult, FitSettings, fit_bones
from pasdedeux.fitting.terms import (
    AccelerationTerm,
    DistanceTerm,
    HalfSpaceTerm,
    PointTerm,
    QuadraticTerm,
    Term,
    total_energy,
)

__all__ = [
    "AccelerationTerm",
    "BoneForest",
    "BoneState",
    "DistanceTerm",
    "FitResult",
    "FitSettings",
    "HalfSpaceTerm",
    "PointTerm",
    "QuadraticTerm",
    "Term",
    "fit_bones",
    "total_energy",
]
