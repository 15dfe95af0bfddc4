"""The work of a shard of virtual video: a take seen through virtual cameras, as annotations and true cameras."""

from __future__ import annotations

from typing import Any

import numpy as np

from pasdedeux.cameras.virtual_video import (
    ViewAngles,
    ViewDistribution,
    VirtualView,
    annotate,
    frame_take,
    sample_views,
)
from pasdedeux.errors import InputError
from pasdedeux.skeletons import OP14, PAIR17
from pasdedeux.verdict import Level, Verdict
from storage_schema import ArtifactRef, Store
from tasks.ingest.parameters import VideoParameters
from tasks.stage import Shard, commit, stream

__all__ = ["UNIFORM_PITCH_DEG", "run_virtual_video"]

NEIGHBOURS = 2
"""Frames kept on either side of a randomly viewed pair, for velocity only (Yin et al. 2018, section 6)."""
UNIFORM_PITCH_DEG = 1e9
"""A deviation of the pitch from here on means uniform; JSON knows no infinity."""
GOOD_SHARE_INSIDE, POOR_SHARE_INSIDE = 0.9, 0.5
"""Share of the joints that are in the image: below the first a video is doubted, below the second useless."""

_OWN_OP14 = OP14.indices(["head", "neck"])
"""Joints of op14 that stand for other points than those of the same name in pair17: nose, middle of the shoulders."""

_OP14_OF_SEEN = [
    PAIR17.num_joints + _OWN_OP14.index(joint) if joint in _OWN_OP14 else PAIR17.index(name)
    for joint, name in enumerate(OP14.joint_names)
]
"""For each joint of op14 its place among the points of virtual video: pair17, then the two of op14's own."""

Columns = dict[str, list[Any]]


def run_virtual_video(shard: Shard, store: Store, parameters: VideoParameters) -> ArtifactRef:
    """See a take through virtual cameras: whole, or pairs from random views with two frames on either side."""
    take_id, count = parameters.take_id, parameters.count
    manifest = store.find("ingest", shard.after[0])
    if manifest is None:
        raise InputError(f"take {take_id} is not in the store; run the whole stage")
    poses = store.read(manifest.ref, "poses", columns=["person", "frame", "pair17_m", "op14_m"])
    num_persons, num_frames = int(manifest.facts["num_persons"]), int(manifest.facts["num_frames"])
    shape = (num_persons, num_frames)
    pair17 = np.asarray(poses["pair17_m"], dtype=np.float64).reshape(*shape, PAIR17.num_joints, 3).swapaxes(0, 1)
    op14 = np.asarray(poses["op14_m"], dtype=np.float64).reshape(*shape, OP14.num_joints, 3).swapaxes(0, 1)

    rng = stream(shard.seed, "ingest", take_id, parameters.purpose)
    angles = sample_views(rng, count, _distribution(parameters))
    is_video = parameters.purpose == "video"
    keys = np.zeros(count, dtype=int) if is_video else _key_frames(rng, num_frames, count)
    rows: Columns = {}
    cameras: Columns = {}
    shares_inside = []
    for index in range(count):
        if is_video:
            frames, key = np.arange(num_frames), None
            sequence_id = f"{take_id}.video{index:02d}"
        else:
            key = int(keys[index])
            frames = np.arange(max(key - NEIGHBOURS, 0), min(key + NEIGHBOURS + 1, num_frames))
            sequence_id = f"{take_id}.view{index:05d}"
        view = _view(parameters, pair17[frames], angles, index)
        inside = _add_seen(rows, parameters, sequence_id, frames, key, view, pair17[frames], op14[frames], rng)
        shares_inside.append(inside)
        _add_camera(cameras, parameters, sequence_id, view)
    return commit(
        shard,
        store,
        tables={"annotations": rows, "cameras": cameras},
        facts={
            "kind": "sequences",
            "takes": [take_id],
            "sequence_ids": cameras["sequence_id"],
            "is_held_out": parameters.is_held_out,
            "is_virtual": True,
            "num_frames": num_frames if is_video else count,
            "num_persons": num_persons,
            "rate_hz": parameters.rate_hz,
            "purpose": parameters.purpose,
        },
        sources=manifest.sources,
        verdict=_verdict(float(np.mean(shares_inside))),
    )


def _verdict(share_inside: float) -> Verdict:
    """Say whether the people are in the image."""
    level = Level.PASS
    if share_inside < GOOD_SHARE_INSIDE:
        level = Level.FAIL if share_inside < POOR_SHARE_INSIDE else Level.WARN
    reason = "" if level is Level.PASS else "many joints lie outside the image; make it larger or the distance greater"
    return Verdict(level, reason, figure="joints in the image", value=100 * share_inside, unit="%")


def _add(columns: Columns, **added: Any) -> None:
    """Add rows; every column is a sequence of the same length."""
    for name, values in added.items():
        columns.setdefault(name, []).extend(values)


def _distribution(parameters: VideoParameters) -> ViewDistribution:
    yaw, pitch = np.deg2rad(parameters.yaw_range_deg), np.deg2rad(parameters.pitch_range_deg)
    deviation = parameters.pitch_deviation_deg
    return ViewDistribution(
        yaw_min_rad=float(yaw[0]),
        yaw_max_rad=float(yaw[1]),
        pitch_mean_rad=float(np.deg2rad(parameters.pitch_mean_deg)),
        pitch_deviation_rad=float("inf") if deviation >= UNIFORM_PITCH_DEG else float(np.deg2rad(deviation)),
        pitch_min_rad=float(pitch[0]),
        pitch_max_rad=float(pitch[1]),
    )


def _key_frames(rng: np.random.Generator, num_frames: int, count: int) -> np.ndarray:
    """Draw the frames that are annotated, each at most once more than any other, neighbours inside the take."""
    low, high = (NEIGHBOURS, num_frames - NEIGHBOURS) if num_frames > 2 * NEIGHBOURS else (0, num_frames)
    rounds = [rng.permutation(np.arange(low, high)) for _ in range(-(-count // (high - low)))]
    return np.concatenate(rounds)[:count]


def _view(parameters: VideoParameters, pair17: np.ndarray, angles: ViewAngles, index: int) -> VirtualView:
    return frame_take(
        pair17,
        pair17[..., PAIR17.root, :],
        distance_m=parameters.distance_m,
        yaw_rad=float(angles.yaw_rad[index]),
        pitch_rad=float(angles.pitch_rad[index]),
        image_size_px=parameters.image_size_px,
    )


def _add_seen(
    rows: Columns,
    parameters: VideoParameters,
    sequence_id: str,
    frames: np.ndarray,
    key: int | None,
    view: VirtualView,
    pair17: np.ndarray,
    op14: np.ndarray,
    rng: np.random.Generator,
) -> float:
    """Add the rows of one sequence and return the share of joints that are in the image.

    Joints of the same name in pair17 and op14 are one detection with one noise.
    """
    px17, px14 = (view.camera.project(points).px for points in (pair17, op14))
    exact = np.concatenate([px17, px14[..., _OWN_OP14, :]], axis=-2)
    is_inside = view.camera.is_inside(exact)
    exact = np.where(is_inside[..., None], exact, np.nan)
    seen = annotate(rng, exact, noise_px=parameters.noise_px, occlusion=parameters.occlusion)
    num_frames, num_persons = exact.shape[:2]
    count = num_frames * num_persons
    px, confidence = seen.px.reshape(count, -1, 2), seen.confidence.reshape(count, -1)
    number = np.repeat(frames - frames[0], num_persons)
    width, height = view.camera.image_size_px
    _add(
        rows,
        sequence_id=[sequence_id] * count,
        frame=number,
        person_id=np.tile(np.arange(num_persons), num_frames),
        partner_id=(1 - np.tile([0, 1], num_frames) if num_persons == 2 else [None] * count),
        source_person_id=np.tile(np.arange(num_persons), num_frames),
        time_s=number / parameters.rate_hz,
        is_key=np.repeat(np.ones(num_frames, bool) if key is None else frames == key, num_persons),
        is_virtual=[True] * count,
        is_held_out=[parameters.is_held_out] * count,
        take_id=[parameters.take_id] * count,
        take_frame=np.repeat(frames, num_persons),
        layout=["pair17"] * count,
        keypoints_px=px[:, : PAIR17.num_joints].reshape(count, -1),
        keypoint_confidence=confidence[:, : PAIR17.num_joints],
        pair17_px=px[:, : PAIR17.num_joints],
        pair17_confidence=confidence[:, : PAIR17.num_joints],
        op14_px=px[:, _OP14_OF_SEEN],
        op14_confidence=confidence[:, _OP14_OF_SEEN],
        image_width_px=[width] * count,
        image_height_px=[height] * count,
        # As with a user's video, nobody knows the lens; `cameras` does.
        focal_px=[None] * count,
    )
    return float(is_inside.mean())


def _add_camera(cameras: Columns, parameters: VideoParameters, sequence_id: str, view: VirtualView) -> None:
    camera = view.camera
    _add(
        cameras,
        sequence_id=[sequence_id],
        take_id=[parameters.take_id],
        is_held_out=[parameters.is_held_out],
        rate_hz=[parameters.rate_hz],
        image_width_px=[camera.image_size_px[0]],
        image_height_px=[camera.image_size_px[1]],
        focal_px=[camera.focal_px],
        principal_point_px=[camera.principal_point_px],
        distance_m=[view.distance_m],
        yaw_rad=[view.yaw_rad],
        pitch_rad=[view.pitch_rad],
        camera_position_m=[camera.position_m],
        camera_from_world_rotmat=[camera.camera_from_world_rotmat],
        noise_px=[parameters.noise_px],
        occlusion=[parameters.occlusion],
    )
