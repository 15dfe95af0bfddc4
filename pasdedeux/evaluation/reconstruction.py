"""Reconstructed motions against the truth: errors per method, and pictures of both."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pasdedeux.evaluation.drawing import PERSON_COLOURS, TRUTH_COLOUR, Panel, Pose, skeleton_sheet
from pasdedeux.evaluation.reconstruction_metrics import (
    jitter_m,
    root_centred_error_m,
    root_removed_error_m,
    scale_free_error_m,
)
from pasdedeux.evaluation.scores import Score, scores_of
from pasdedeux.projections.retarget import mid_hip
from pasdedeux.skeletons import OP14
from pasdedeux.spread import evenly_spread

__all__ = ["Reconstructed", "motion_sheet", "pair_scores", "reconstruction_scores", "reconstruction_sheet"]

Array = npt.NDArray[np.float64]
_BASELINE = "nearest"


@dataclass(frozen=True)
class Reconstructed:
    """One person's motion as reconstructed by several methods, and the truth, all in camera axes.

    Args:
        item: Sequence and person, for the table.
        truth_m: True op14 positions (frame, 14, 3), metres.
        found_m: By method, positions (frame, 14, 3) of the same frames.
        frames: Frames of the sequence (frame,), rising.
        person_id: Who it is in the sequence.
    """

    item: str
    truth_m: Array
    found_m: Mapping[str, Array]
    frames: npt.NDArray[np.int64]
    person_id: int = 0


def reconstruction_scores(person: Reconstructed, *, split: str) -> list[Score]:
    """Score every method: mean errors over op14 with root rotation kept, removed, and free of scale; and jitter.

    `standing_still` is the baseline that always answers with the mean true pose of the motion, which no method may use:
    it says how much the person moves at all.
    """
    still = np.broadcast_to((person.truth_m - mid_hip(person.truth_m)[:, None]).mean(axis=0), person.truth_m.shape)
    scores = []
    for method, found in {**person.found_m, "standing_still": still}.items():
        figures = {
            "error_root_kept": float(root_centred_error_m(found, person.truth_m).mean()),
            "error_root_removed": float(root_removed_error_m(found, person.truth_m).mean()),
            "error_scale_free": float(scale_free_error_m(found, person.truth_m).mean()),
            "jitter": jitter_m(found),
        }
        is_baseline = method in (_BASELINE, "standing_still")
        more = {"split": split, "item": person.item, "count": len(person.truth_m)}
        scores += scores_of(figures, method, "m", is_baseline=is_baseline, **more)
    scores.append(Score("jitter", "truth", jitter_m(person.truth_m), "m", True, split, person.item))
    return scores


def pair_scores(first: Reconstructed, second: Reconstructed, *, split: str, item: str) -> list[Score]:
    """Score where two people are found relative to each other, over the frames that have both.

    `pair_distance_error` is how far the distance of their mid-hips is off, `pair_place_error` how far the vector
    between them is, `pair_depth_error` its part along the camera's axis.  The baseline
    `equal_depth` takes both people to be equally far from the camera (of the last method).
    """
    common = np.intersect1d(first.frames, second.frames)
    if not len(common):
        return []
    at = [np.searchsorted(person.frames, common) for person in (first, second)]
    true = mid_hip(second.truth_m[at[1]]) - mid_hip(first.truth_m[at[0]])
    between = {
        method: mid_hip(second.found_m[method][at[1]]) - mid_hip(first.found_m[method][at[0]])
        for method in first.found_m
        if method in second.found_m
    }
    if between:
        between["equal_depth"] = list(between.values())[-1] * [1.0, 1.0, 0.0]
    scores = []
    for method, found in between.items():
        figures = {
            "pair_distance_error": np.abs(np.linalg.norm(found, axis=-1) - np.linalg.norm(true, axis=-1)).mean(),
            "pair_place_error": np.linalg.norm(found - true, axis=-1).mean(),
            "pair_depth_error": np.abs(found[:, 2] - true[:, 2]).mean(),
        }
        is_baseline = method in (_BASELINE, "equal_depth")
        scores += scores_of(figures, method, "m", is_baseline=is_baseline, split=split, item=item, count=len(common))
    return scores


def motion_sheet(title: str, people: Sequence[Mapping[int, Array]], *, num_moments: int = 7) -> bytes:
    """Draw moments of a sequence whose truth nobody knows, everybody in place; PNG bytes.

    Args:
        title: Heading of the picture.
        people: For each person the op14 positions (14, 3) by frame, camera axes, metres; of at least one frame.
        num_moments: Moments drawn, evenly spread over the frames that have anybody.
    """
    frames = sorted({frame for person in people for frame in person})
    chosen = evenly_spread(len(frames), num_moments)
    panels = []
    for frame in (frames[index] for index in chosen):
        seen = [(index, person[frame]) for index, person in enumerate(people) if frame in person]
        middle = np.mean([mid_hip(pose) for _, pose in seen], axis=0)
        poses = tuple(
            Pose(OP14, pose - middle + [0.0, 1.0, 0.0], PERSON_COLOURS[index % len(PERSON_COLOURS)])
            for index, pose in seen
        )
        panels.append(Panel(title=f"frame {frame}", poses=poses))
    return skeleton_sheet(panels, title=f"{title}; as the camera sees it (top), from its side (bottom)")


def reconstruction_sheet(person: Reconstructed, method: str, *, num_moments: int = 7) -> bytes:
    """Draw moments of a reconstruction over the grey truth, both centred on the mid-hip; PNG bytes."""
    frames = evenly_spread(len(person.truth_m), num_moments)
    panels = []
    for frame in frames:
        truth, found = (
            pose - mid_hip(pose) + [0.0, 1.0, 0.0] for pose in (person.truth_m[frame], person.found_m[method][frame])
        )
        error = float(root_centred_error_m(found, truth)) * 100
        poses = (Pose(OP14, truth, TRUTH_COLOUR), Pose(OP14, found, PERSON_COLOURS[0]))
        panels.append(Panel(title=f"frame {frame}: {error:.1f} cm", poses=poses))
    return skeleton_sheet(
        panels, title=f"{person.item}, {method}: truth in grey; as the camera sees it (top), from its side (bottom)"
    )
