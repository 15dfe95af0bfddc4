"""Reconstructed motions against the truth: errors per method, and pictures of both."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array
from pasdedeux.evaluation.players import TRUTH_COLOUR, Figure, pack_player, people_panel, shown_frames
from pasdedeux.evaluation.reconstruction_metrics import (
    jitter_m,
    root_centred_error_m,
    root_removed_error_m,
    scale_free_error_m,
)
from pasdedeux.evaluation.scores import Score, scores_of
from pasdedeux.evaluation.verdicts import Items
from pasdedeux.kinematics.rotations import rotate, swing_between
from pasdedeux.projections.retarget import mid_hip
from pasdedeux.skeletons import OP14

_BASELINE = "nearest"
_MIN_DISTANCE_M = 0.5


@dataclass(frozen=True)
class Reconstructed:
    """One person's motion as reconstructed by several methods, and the truth, all in camera axes.

    Args:
        item: Sequence and person, for the table.
        truth_m: True op14 positions (frame, 14, 3), metres.
        found_m: By method, positions (frame, 14, 3) of the same frames.
        frames: Frames of the sequence (frame,), rising.
        person_id: Who it is in the sequence.
        takes: Take of each frame.
        times_s: Its time within the take, seconds.
    """

    item: str
    truth_m: Array
    found_m: Mapping[str, Array]
    frames: npt.NDArray[np.int64]
    person_id: int = 0
    takes: Sequence[str] = ()
    times_s: Sequence[float] = ()


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


def reconstruction_items(people: Sequence[Reconstructed]) -> Items:
    """Return the error of every pose with root rotation kept, beside the nearest pose of the database."""
    parts = []
    for person in people:
        errors = {method: root_centred_error_m(found, person.truth_m) for method, found in person.found_m.items()}
        parts.append(Items(errors, person.takes, person.times_s, (_BASELINE,)))
    return Items.joined(parts)


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


def reconstruction_player(
    found_m: Array, *, rate_hz: float, keypoints_px: Array | None = None, truth_m: Array | None = None
) -> bytes:
    """Show people as they were reconstructed over the thin grey truth, and the image that they were found in.

    The middle of all people stays in the middle, so their places to each other show.

    Args:
        found_m: The reconstruction (frame, person, 14, 3), camera axes, metres; NaN where a person is not there.
        rate_hz: Frames per second.
        keypoints_px: The image (frame, person, 14, 2), pixels, y down; NaN where not seen.
        truth_m: The true motion (frame, person, 14, 3), camera axes, where it is known.
    """
    frames, shown_hz = shown_frames(len(found_m), rate_hz)
    found = about_hips(found_m[frames])
    panels, labels = [], []
    if keypoints_px is not None:
        seen = keypoints_px[frames] * [1.0, -1.0]
        size = _height(found) / max(_height(seen), 1e-9)
        middle = np.stack([_middle(points.reshape(-1, 2)) for points in seen])[:, None, None]
        panels.append(replace(people_panel("image", OP14, np.insert((seen - middle) * size, 2, 0.0, -1)), is_flat=True))
    solid = people_panel("reconstruction", OP14, found)
    if truth_m is not None:
        truth = about_hips(truth_m[frames])
        solid = replace(solid, title="reconstruction, truth in grey")
        grey = [Figure(OP14, truth[:, person], TRUTH_COLOUR, is_thin=True) for person in range(truth.shape[1])]
        solid = replace(solid, figures=(*grey, *solid.figures))
        errors = 100.0 * np.linalg.norm(found - truth, axis=-1)
        for frame, error in zip(frames, errors, strict=True):
            known = error[np.isfinite(error)]
            labels.append(f"{frame / rate_hz:.1f} s" + (f", {known.mean():.1f} cm" if len(known) else ""))
    return pack_player([*panels, solid], rate_hz=shown_hz, labels=labels, has_floor=False)


def about_hips(positions_m: Array) -> Array:
    """Return positions (frame, person, 14, 3) about the mean mid-hip of the people who are there."""
    hips = mid_hip(positions_m)
    is_there = np.isfinite(hips).all(axis=-1, keepdims=True)
    total = np.where(is_there, hips, 0.0).sum(axis=1, keepdims=True)
    return np.asarray(positions_m - (total / np.maximum(is_there.sum(axis=1, keepdims=True), 1))[:, :, None])


def turn_to_camera(motion_m: Array, place_m: Array) -> Array:
    """Turn a motion in camera axes so that it is seen along the ray to where people are, as their image shows them.

    A camera sees somebody at the edge of its image from another side than somebody in the middle.

    Args:
        motion_m: What is turned (frame, person, 14, 3), camera axes, metres.
        place_m: People in their place (frame, person, 14, 3), the camera at the origin; frames in which their middle
            is nearer than half a metre, as without a known place, are left as they are.
    """
    places = place_m.reshape(len(place_m), -1, 3)
    is_there = np.isfinite(places).all(axis=-1, keepdims=True)
    middle = np.where(is_there, places, 0.0).sum(axis=1) / np.maximum(is_there.sum(axis=1), 1)
    distance = np.linalg.norm(middle, axis=-1, keepdims=True)
    to_camera = np.where(distance > _MIN_DISTANCE_M, -middle / np.maximum(distance, 1e-9), [0.0, 0.0, 1.0])
    turn = swing_between(to_camera, np.broadcast_to([0.0, 0.0, 1.0], to_camera.shape))
    return np.asarray(rotate(turn[:, None, None], motion_m))


def _height(points: Array) -> float:
    """Return the height that all people of a frame take, its median over the frames with anybody; 1 without any."""
    height = points[..., 1].reshape(len(points), -1)
    known = [row[np.isfinite(row)] for row in height if np.isfinite(row).any()]
    return float(np.median([np.ptp(row) for row in known])) if known else 1.0


def _middle(points: Array) -> Array:
    """Return the middle (2,) of those points (n, 2) that are there."""
    known = points[np.isfinite(points).all(axis=-1)]
    return np.median(known, axis=0) if len(known) else np.zeros(2)
