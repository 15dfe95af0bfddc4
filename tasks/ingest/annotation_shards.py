"""The work of the shards that give annotations: virtual video over a take, and 2D poses of the user's own."""

from __future__ import annotations

import hashlib
from pathlib import Path
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
from pasdedeux.skeletons.layouts import KEYPOINT_LAYOUTS
from storage_schema import ArtifactRef, SourceCredit, Store
from tasks.ingest.annotation_sources import read_annotations
from tasks.ingest.parameters import AnnotationOptions
from tasks.stage import Shard, commit, stream

__all__ = ["run_annotations", "run_virtual_video"]

NEIGHBOURS = 2
"""Frames kept on either side of a randomly viewed pair, for velocity only (Yin et al. 2018, section 6)."""
DEFAULT_RATE_HZ = 30.0


def run_virtual_video(shard: Shard, store: Store) -> ArtifactRef:
    """See a take through virtual cameras: whole, or pairs from random views with two frames on either side."""
    parameters = shard.parameters
    manifest = store.find("ingest", shard.after[0])
    if manifest is None:
        raise InputError(f"take {parameters['take_id']} is not in the store; run the whole stage")
    poses = store.read(manifest.ref, "poses", columns=["person", "frame", "pair17_m", "op14_m"])
    num_persons, num_frames = int(manifest.facts["num_persons"]), int(manifest.facts["num_frames"])
    shape = (num_persons, num_frames)
    pair17 = np.asarray(poses["pair17_m"], dtype=np.float64).reshape(*shape, PAIR17.num_joints, 3).swapaxes(0, 1)
    op14 = np.asarray(poses["op14_m"], dtype=np.float64).reshape(*shape, OP14.num_joints, 3).swapaxes(0, 1)

    rng = stream(shard.seed, "ingest", parameters["take_id"], parameters["kind"])
    count = int(parameters["count"])
    angles = sample_views(rng, count, _distribution(parameters))
    is_video = parameters["kind"] == "video"
    keys = np.zeros(count, dtype=int) if is_video else _key_frames(rng, num_frames, count)
    rows, cameras = _Rows(), _Rows()
    for index in range(count):
        if is_video:
            frames, key = np.arange(num_frames), None
            sequence_id = f"{parameters['take_id']}.video{index:02d}"
        else:
            key = int(keys[index])
            frames = np.arange(max(key - NEIGHBOURS, 0), min(key + NEIGHBOURS + 1, num_frames))
            sequence_id = f"{parameters['take_id']}.view{index:05d}"
        view = _view(parameters, pair17[frames], angles, index)
        _add_seen(rows, parameters, sequence_id, frames, key, view, pair17[frames], op14[frames], rng)
        _add_camera(cameras, parameters, sequence_id, view)
    sequence_ids = [str(name) for name in cameras.columns["sequence_id"]]
    return commit(
        shard,
        store,
        tables={"annotations": rows.sorted_columns(), "cameras": cameras.sorted_columns()},
        facts={
            "kind": "sequences",
            "takes": [parameters["take_id"]],
            "sequence_ids": sequence_ids,
            "is_held_out": parameters["is_held_out"],
            "is_virtual": True,
            "num_frames": num_frames if is_video else count,
            "num_persons": num_persons,
            "rate_hz": parameters["rate_hz"],
            "purpose": parameters["kind"],
        },
        sources=manifest.sources,
    )


def run_annotations(shard: Shard, store: Store) -> ArtifactRef:
    """Read a source of 2D poses and derive the working skeletons."""
    parameters = dict(shard.parameters)
    is_held_out, kind = parameters.pop("is_held_out"), parameters.pop("format")
    del parameters["kind"], parameters["frames"]
    options = AnnotationOptions(path=Path(shard.files[0].path), **parameters)
    files = []
    for file in shard.files:
        data = Path(file.path).read_bytes()
        if hashlib.sha256(data).hexdigest() != file.sha256:
            raise InputError(f"file {file.path} changed since the run was planned; run again")
        files.append((Path(file.path).name, data))
    found = read_annotations(options, kind, files)
    frames = found.frames
    layout = KEYPOINT_LAYOUTS[frames.layout]
    rate = options.rate_hz or frames.rate_hz or DEFAULT_RATE_HZ
    size = options.image_size_px or frames.image_size_px
    pair17 = layout.derive("pair17", frames.keypoints_px, frames.confidence)
    op14 = layout.derive("op14", frames.keypoints_px, frames.confidence)
    count = frames.num_rows
    sequence_ids = sorted(set(frames.sequence_id))
    per_frame: dict[tuple[str, int], int] = {}
    for sequence, number in zip(frames.sequence_id, frames.frame.tolist(), strict=True):
        per_frame[sequence, number] = per_frame.get((sequence, number), 0) + 1
    return commit(
        shard,
        store,
        tables={
            "annotations": {
                "sequence_id": list(frames.sequence_id),
                "frame": frames.frame,
                "person_id": frames.person_id,
                "time_s": frames.frame / rate,
                "is_key": np.ones(count, dtype=bool),
                "is_virtual": np.zeros(count, dtype=bool),
                "is_held_out": np.full(count, is_held_out),
                "take_id": [options.take_id] * count,
                "take_frame": [None] * count,
                "layout": [frames.layout] * count,
                "keypoints_px": [row.reshape(-1) for row in frames.keypoints_px],
                "keypoint_confidence": list(frames.confidence),
                "pair17_px": pair17.positions,
                "pair17_confidence": pair17.confidence,
                "op14_px": op14.positions,
                "op14_confidence": op14.confidence,
                "image_width_px": [size[0] if size else None] * count,
                "image_height_px": [size[1] if size else None] * count,
            }
        },
        facts={
            "kind": "sequences",
            "takes": [options.take_id] if options.take_id else [],
            "sequence_ids": sequence_ids,
            "is_held_out": is_held_out,
            "is_virtual": False,
            "num_frames": len(per_frame),
            "num_persons": max(per_frame.values()),
            "rate_hz": rate,
            "purpose": "given",
            "format": kind,
            "layout": frames.layout,
            "num_skipped_frames": len(found.skipped),
            "skipped_files": list(found.skipped[:20]),
        },
        sources=[SourceCredit(name=options.id, licence=options.licence, credit=options.credit)],
    )


class _Rows:
    """Columns that grow block by block."""

    def __init__(self) -> None:
        self.columns: dict[str, list[Any]] = {}

    def add(self, **columns: Any) -> None:
        """Add rows; every column is a sequence of the same length."""
        for name, values in columns.items():
            self.columns.setdefault(name, []).extend(values)

    def sorted_columns(self) -> dict[str, Any]:
        """Return the columns; sequences were added in the order of their names, so rows are sorted."""
        return self.columns


def _distribution(parameters: Any) -> ViewDistribution:
    yaw, pitch = np.deg2rad(parameters["yaw_range_deg"]), np.deg2rad(parameters["pitch_range_deg"])
    deviation = float(parameters["pitch_deviation_deg"])
    return ViewDistribution(
        yaw_min_rad=float(yaw[0]),
        yaw_max_rad=float(yaw[1]),
        pitch_mean_rad=float(np.deg2rad(parameters["pitch_mean_deg"])),
        pitch_deviation_rad=float("inf") if deviation >= UNIFORM_PITCH_DEG else float(np.deg2rad(deviation)),
        pitch_min_rad=float(pitch[0]),
        pitch_max_rad=float(pitch[1]),
    )


def _key_frames(rng: np.random.Generator, num_frames: int, count: int) -> np.ndarray:
    """Draw the frames that are annotated, each at most once more than any other, neighbours inside the take."""
    low, high = (NEIGHBOURS, num_frames - NEIGHBOURS) if num_frames > 2 * NEIGHBOURS else (0, num_frames)
    rounds = [rng.permutation(np.arange(low, high)) for _ in range(-(-count // (high - low)))]
    return np.concatenate(rounds)[:count]


def _view(parameters: Any, pair17: np.ndarray, angles: ViewAngles, index: int) -> VirtualView:
    size = parameters["image_size_px"]
    return frame_take(
        pair17,
        pair17[..., PAIR17.root, :],
        distance_m=float(parameters["distance_m"]),
        yaw_rad=float(angles.yaw_rad[index]),
        pitch_rad=float(angles.pitch_rad[index]),
        image_size_px=tuple(size) if size else None,
    )


def _add_seen(
    rows: _Rows,
    parameters: Any,
    sequence_id: str,
    frames: np.ndarray,
    key: int | None,
    view: VirtualView,
    pair17: np.ndarray,
    op14: np.ndarray,
    rng: np.random.Generator,
) -> None:
    """Add the rows of one sequence: joints of the same name in pair17 and op14 are one detection with one noise."""
    px17, px14 = (view.camera.project(points).px for points in (pair17, op14))
    exact = np.concatenate([px17, px14[..., _OWN_OP14, :]], axis=-2)
    exact = np.where(view.camera.is_inside(exact)[..., None], exact, np.nan)
    seen = annotate(rng, exact, noise_px=float(parameters["noise_px"]), occlusion=float(parameters["occlusion"]))
    num_frames, num_persons = exact.shape[:2]
    count = num_frames * num_persons
    px, confidence = seen.px.reshape(count, -1, 2), seen.confidence.reshape(count, -1)
    number = np.repeat(frames - frames[0], num_persons)
    width, height = view.camera.image_size_px
    rows.add(
        sequence_id=[sequence_id] * count,
        frame=number,
        person_id=np.tile(np.arange(num_persons), num_frames),
        time_s=number / float(parameters["rate_hz"]),
        is_key=np.repeat(np.ones(num_frames, bool) if key is None else frames == key, num_persons),
        is_virtual=[True] * count,
        is_held_out=[bool(parameters["is_held_out"])] * count,
        take_id=[parameters["take_id"]] * count,
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
    )


def _add_camera(cameras: _Rows, parameters: Any, sequence_id: str, view: VirtualView) -> None:
    camera = view.camera
    cameras.add(
        sequence_id=[sequence_id],
        take_id=[parameters["take_id"]],
        is_held_out=[bool(parameters["is_held_out"])],
        rate_hz=[float(parameters["rate_hz"])],
        image_width_px=[camera.image_size_px[0]],
        image_height_px=[camera.image_size_px[1]],
        focal_px=[camera.focal_px],
        principal_point_px=[camera.principal_point_px],
        distance_m=[view.distance_m],
        yaw_rad=[view.yaw_rad],
        pitch_rad=[view.pitch_rad],
        camera_position_m=[camera.position_m],
        camera_from_world_rotmat=[camera.camera_from_world_rotmat],
        noise_px=[float(parameters["noise_px"])],
        occlusion=[float(parameters["occlusion"])],
    )


UNIFORM_PITCH_DEG = 1e9
"""A deviation of the pitch from here on means uniform; JSON knows no infinity."""

_OWN_OP14 = OP14.indices(["head", "neck"])
"""Joints of op14 that stand for other points than those of the same name in pair17: nose, middle of the shoulders."""

_OP14_OF_SEEN = [
    PAIR17.num_joints + _OWN_OP14.index(joint) if joint in _OWN_OP14 else PAIR17.index(name)
    for joint, name in enumerate(OP14.joint_names)
]
"""For each joint of op14 its place among the points of virtual video: pair17, then the two of op14's own."""
