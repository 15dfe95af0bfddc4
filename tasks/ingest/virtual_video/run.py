"""The work of a shard of virtual video: annotations of a take by virtual cameras, and the true cameras."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from pasdedeux.arrays import merge_axes
from pasdedeux.cameras.virtual_video import (
    Annotated,
    VirtualView,
    add_junk,
    annotate_pixels,
    frame_take,
    passer_by,
    sample_views,
)
from pasdedeux.people.identity import identity_switches
from pasdedeux.people.resolution import ResolvedSequence, SequenceRows, resolve_sequence
from pasdedeux.sampling.annotations import is_left_out
from pasdedeux.skeletons import OP14, PAIR17
from pasdedeux.skeletons.layouts import KeypointLayout
from pasdedeux.skeletons.layouts.keypoints import Keypoints
from pasdedeux.verdict import Level, Verdict
from storage_schema import ArtifactRef, Store
from tasks.ingest.virtual_video.parameters import UNIFORM_PITCH_DEG, VideoParameters
from tasks.rows.takes import read_motion
from tasks.stage import Shard
from tasks.stage.committing import commit, followed, join_columns
from tasks.stage.facts import DetectedSequence, SequenceFacts, TakeFacts
from tasks.stage.streams import stream

NEIGHBOURS = 2
"""Frames kept on either side of a randomly viewed pair, for velocity only (Yin et al. 2018, section 6)."""
GOOD_SHARE_INSIDE, POOR_SHARE_INSIDE = 0.9, 0.5
"""Share of joints inside the image below which a video gets a warning, and below which it fails."""

_OWN_OP14 = OP14.indices(["head", "neck"])
"""Joints of op14 with another meaning than in pair17: nose and middle of the shoulders."""

_LAYOUT = KeypointLayout(
    name="virtual",
    keypoint_names=(*PAIR17.joint_names, "nose", "mid_shoulder"),
    recipes={
        PAIR17.name: {joint: ({joint: 1.0},) for joint in PAIR17.joint_names},
        OP14.name: {
            joint: ({{"head": "nose", "neck": "mid_shoulder"}.get(joint, joint): 1.0},) for joint in OP14.joint_names
        },
    },
)
"""Keypoints of virtual cameras: pair17, then the two of op14 with another meaning."""

Columns = dict[str, Any]

_MISSED = 0.1
"""Share of the joints that a detector misses, drawn independently."""
_NUM_JUNK_JOINTS = 3
"""Number of joints of each person and frame at random places of the image, with a confidence below 0.2."""
_PASSER_BY_SHARE = 0.25
"""Share of the time in which a third person walks through."""


def run_virtual_video(shard: Shard, store: Store, parameters: VideoParameters) -> ArtifactRef:
    """Project a take through virtual cameras: whole videos, or random views with two frames on either side."""
    take_id, count = parameters.take_id, parameters.count
    (manifest,) = followed(shard, store)
    take = TakeFacts.of(manifest)
    if "poses" not in manifest.tables:
        return commit(shard, store, tables={}, facts=SequenceFacts(takes=(), skipped=take.skipped))
    poses = read_motion(store, manifest.ref, "pair17_m", "op14_m")
    pair17, op14 = poses["pair17_m"], poses["op14_m"]
    num_frames, num_persons = pair17.shape[:2]

    # A detector has the same cameras and the same noise; its faults are drawn from another stream.
    rng = stream(shard.seed, "ingest", take_id, parameters.purpose)
    faults = stream(shard.seed, "ingest", take_id, "detector")
    deviation = parameters.pitch_deviation_deg
    yaw_rad, pitch_rad = sample_views(
        rng,
        count,
        pitch_mean_rad=float(np.deg2rad(parameters.pitch_mean_deg)),
        pitch_deviation_rad=float("inf") if deviation >= UNIFORM_PITCH_DEG else float(np.deg2rad(deviation)),
    )
    is_video = parameters.purpose == "video"
    keys = [None] * count if is_video else _key_frames(rng, num_frames, count).tolist()
    rows: list[Columns] = []
    cameras: list[Columns] = []
    detected: list[DetectedSequence] = []
    shares_inside = []
    for index, key in enumerate(keys):
        first, last = (0, num_frames) if key is None else (max(key - NEIGHBOURS, 0), key + NEIGHBOURS + 1)
        frames = np.arange(first, min(last, num_frames))
        sequence_id = f"{take_id}.video{index:02d}" if is_video else f"{take_id}.view{index:05d}"
        view = frame_take(
            pair17[frames],
            pair17[frames][..., PAIR17.root, :],
            distance_m=parameters.distance_m,
            yaw_rad=float(yaw_rad[index]),
            pitch_rad=float(pitch_rad[index]),
        )
        exact = _see(view, pair17[frames], op14[frames])
        shares_inside.append(float(np.isfinite(exact[..., 0]).mean()))
        occlusion = _MISSED if parameters.detector else parameters.occlusion
        seen = annotate_pixels(rng, exact, noise_px=parameters.noise_px, occlusion=occlusion)
        if parameters.detector:
            sequence_id += ".detector"
            seen_by = _detect(sequence_id, parameters, view, seen, pair17[frames], op14[frames], faults)
            sequence, facts = _detected(sequence_id, *seen_by)
            detected.append(facts)
        else:
            sequence = _known(frames, key, seen)
        rows.append(_rows(parameters, sequence_id, view, **sequence))
        cameras.append(_camera(parameters, sequence_id, view, occlusion))
    table, cameras_table = join_columns(rows), join_columns(cameras)
    left_out = is_left_out(table["sequence_id"], table["frame"], parameters.leave_one_out_every)
    table["is_held_out"] = left_out | parameters.is_held_out
    return commit(
        shard,
        store,
        tables={"annotations": table, "cameras": cameras_table},
        facts=SequenceFacts(
            takes=(take_id,),
            sequence_ids=cameras_table["sequence_id"],
            is_held_out=parameters.is_held_out,
            is_virtual=True,
            is_built_in=take.is_built_in,
            num_frames=num_frames if is_video else count,
            num_persons=num_persons,
            rate_hz=parameters.rate_hz,
            purpose=parameters.purpose,
            detected=tuple(detected),
        ),
        sources=manifest.sources,
        verdict=_verdict(shares_inside),
    )


def _verdict(shares_inside: Sequence[float]) -> Verdict:
    """Judge the video by the share of joints inside the image."""
    level, share_inside = Level.PASS, float(np.mean(shares_inside))
    if share_inside < GOOD_SHARE_INSIDE:
        level = Level.FAIL if share_inside < POOR_SHARE_INSIDE else Level.WARN
    reason = "" if level is Level.PASS else "many joints lie outside the image; make it larger or the distance greater"
    figure = ("joints in the image", 100 * share_inside, "%")
    return Verdict(level, reason, *figure, count=len(shares_inside), thing="sequences")


def _key_frames(rng: np.random.Generator, num_frames: int, count: int) -> np.ndarray:
    """Draw the annotated frames, with neighbours inside the take; counts differ by at most one."""
    low, high = (NEIGHBOURS, num_frames - NEIGHBOURS) if num_frames > 2 * NEIGHBOURS else (0, num_frames)
    rounds = [rng.permutation(np.arange(low, high)) for _ in range(-(-count // (high - low)))]
    return np.concatenate(rounds)[:count]


def _see(view: VirtualView, pair17: np.ndarray, op14: np.ndarray) -> np.ndarray:
    """Return exact pixels (frame, person, point, 2) of the points of `_LAYOUT`; NaN outside the image.

    Joints of the same name in pair17 and op14 are one detection with one noise.
    """
    px17, px14 = (view.camera.project(points).px for points in (pair17, op14))
    exact = np.concatenate([px17, px14[..., _OWN_OP14, :]], axis=-2)
    return np.where(view.camera.is_inside(exact)[..., None], exact, np.nan)


def _detect(
    sequence_id: str,
    parameters: VideoParameters,
    view: VirtualView,
    seen: Annotated,
    pair17: np.ndarray,
    op14: np.ndarray,
    rng: np.random.Generator,
) -> tuple[ResolvedSequence, np.ndarray]:
    """Return the resolved sequence of a virtual detector, and the true person of each row (row,).

    A passer-by is added to the people of the take.  People are in random order in every frame.
    """
    px, confidence = seen.px, seen.confidence
    count = round(_PASSER_BY_SHARE * len(pair17))
    if count:
        start = (len(pair17) - count) // 2
        there = slice(start, start + count)
        joined = np.concatenate([pair17[:, 0], op14[:, 0]], axis=-2)[there]
        centre = pair17[there, :, PAIR17.root].mean(axis=(0, 1))
        moved = passer_by(
            rng, joined, centre, towards_camera=view.camera.position_m - centre, rate_hz=parameters.rate_hz
        )
        exact = _see(view, moved[:, : PAIR17.num_joints], moved[:, PAIR17.num_joints :])
        extra = annotate_pixels(rng, exact, noise_px=parameters.noise_px, occlusion=_MISSED)
        px = np.concatenate([px, np.full((len(px), 1, *px.shape[2:]), np.nan)], axis=1)
        confidence = np.concatenate([confidence, np.zeros((len(px), 1, px.shape[2]))], axis=1)
        px[there, -1], confidence[there, -1] = extra.px, extra.confidence
    seen = add_junk(rng, Annotated(px, confidence), _NUM_JUNK_JOINTS, view.camera.image_size_px)
    order = np.argsort(rng.random(seen.confidence.shape[:2]), axis=1)
    frame = np.repeat(np.arange(len(order)), order.shape[1])
    is_there = (seen.confidence[frame, order.reshape(-1)] > 0).any(axis=-1)
    frame, person = frame[is_there], order.reshape(-1)[is_there]
    place = np.concatenate([np.arange(np.count_nonzero(frame == number)) for number in np.unique(frame)])
    rows = SequenceRows(
        frame, place, seen.px[frame, person], seen.confidence[frame, person], np.arange(len(frame), dtype=np.int64)
    )
    resolved = resolve_sequence(sequence_id, rows, _LAYOUT, rate_hz=parameters.rate_hz, has_identities=False)
    return resolved, person[resolved.rows.source_row]


def _detected(sequence_id: str, resolved: ResolvedSequence, true_id: np.ndarray) -> tuple[Columns, DetectedSequence]:
    """Return the columns of a detector's sequence, and scores of the identities.

    A resolved person gets the number of its most frequent true person; others get numbers after those.
    """
    people, person = np.unique(resolved.rows.person_id, return_inverse=True)
    counts = np.zeros((len(people), int(true_id.max()) + 1), dtype=np.int64)
    np.add.at(counts, (person, true_id), 1)
    names: dict[int, int] = {}
    for at in np.argsort(-counts, axis=None, kind="stable"):
        layout_index, name = (int(index) for index in np.unravel_index(at, counts.shape))
        if layout_index not in names and name not in names.values() and counts[layout_index, name]:
            names[layout_index] = name
    for layout_index in range(len(people)):
        names.setdefault(layout_index, max([*names.values(), counts.shape[1] - 1]) + 1)
    number = resolved.rows.frame
    renamed = {int(old): names[layout_index] for layout_index, old in enumerate(people)}
    columns = {
        "number": number,
        "take_frame": number,
        "person_id": np.array([renamed[person_id] for person_id in resolved.rows.person_id.tolist()]),
        "partner_id": [renamed.get(partner) for partner in resolved.partner_id.tolist()],
        "source_person_id": [None] * len(number),
        "is_key": np.ones(len(number), dtype=bool),
        "seen": Annotated(resolved.rows.keypoints_px, resolved.rows.confidence),
        "op14": resolved.op14,
    }
    couples = [sorted((renamed[pair.first], renamed[pair.second])) for pair in resolved.decided.pairs]
    return columns, DetectedSequence(
        sequence_id=sequence_id,
        num_people=len(people),
        num_true_people=len(np.unique(true_id)),
        num_identity_switches=identity_switches(true_id, resolved.rows.person_id, number),
        couples=tuple((layout_index, other) for layout_index, other in couples),
    )


def _known(frames: np.ndarray, key: int | None, seen: Annotated) -> Columns:
    """Return the columns of a sequence with known people."""
    num_frames, num_persons = seen.confidence.shape[:2]
    count = num_frames * num_persons
    flat = Annotated(merge_axes(seen.px, 0, 2), merge_axes(seen.confidence, 0, 2))
    person = np.tile(np.arange(num_persons), num_frames)
    return {
        "number": np.repeat(frames - frames[0], num_persons),
        "take_frame": np.repeat(frames, num_persons),
        "person_id": person,
        "partner_id": (1 - person).tolist() if num_persons == 2 else [None] * count,
        "source_person_id": person.tolist(),
        "is_key": np.repeat(np.ones(num_frames, bool) if key is None else frames == key, num_persons),
        "seen": flat,
        "op14": _LAYOUT.derive(OP14.name, flat.px, flat.confidence),
    }


def _rows(
    parameters: VideoParameters,
    sequence_id: str,
    view: VirtualView,
    *,
    number: np.ndarray,
    seen: Annotated,
    op14: Keypoints,
    **columns: Any,
) -> Columns:
    """Return the rows of a sequence; `seen` has the points of `_LAYOUT`."""
    count = len(number)
    width, height = view.camera.image_size_px
    px, confidence = seen.px[:, : PAIR17.num_joints], seen.confidence[:, : PAIR17.num_joints]
    return {
        "sequence_id": [sequence_id] * count,
        "frame": number,
        "time_s": number / parameters.rate_hz,
        "is_virtual": [True] * count,
        "take_id": [parameters.take_id] * count,
        "layout": ["pair17"] * count,
        "keypoints_px": list(merge_axes(px, 1)),
        "keypoint_confidence": list(confidence),
        "pair17_px": px,
        "pair17_confidence": confidence,
        "op14_px": op14.positions,
        "op14_confidence": op14.confidence,
        "image_width_px": [width] * count,
        "image_height_px": [height] * count,
        # The lens is unknown, as for a user's video; it is in `cameras`.
        "focal_px": [None] * count,
        **columns,
    }


def _camera(parameters: VideoParameters, sequence_id: str, view: VirtualView, occlusion: float) -> Columns:
    camera = view.camera
    columns = {
        "sequence_id": sequence_id,
        "take_id": parameters.take_id,
        "is_held_out": parameters.is_held_out,
        "rate_hz": parameters.rate_hz,
        "image_width_px": camera.image_size_px[0],
        "image_height_px": camera.image_size_px[1],
        "focal_px": camera.focal_px,
        "principal_point_px": camera.principal_point_px,
        "distance_m": view.distance_m,
        "yaw_rad": view.yaw_rad,
        "pitch_rad": view.pitch_rad,
        "camera_position_m": camera.position_m,
        "camera_from_world_rotmat": camera.camera_from_world_rotmat,
        "noise_px": parameters.noise_px,
        "occlusion": occlusion,
    }
    return {name: [value] for name, value in columns.items()}
