"""Fitting: poses fitted to observations with exact bone lengths."""

from pasdedeux.fitting.bones import BoneForest, BoneState
from pasdedeux.fitting.levenberg import FitResult, FitSettings, fit_bones
from pasdedeux.fitting.terms import DifferenceTerm, DistanceTerm, HalfSpaceTerm, PointTerm, QuadraticTerm, Term

__all__ = [
    "BoneForest",
    "BoneState",
    "DifferenceTerm",
    "DistanceTerm",
    "FitResult",
    "FitSettings",
    "HalfSpaceTerm",
    "PointTerm",
    "QuadraticTerm",
    "Term",
    "fit_bones",
]
