"""Small files of every format that ingest reads, and an asymmetric figure that betrays mirroring."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from pasdedeux.formats.bvh_writer import write_bvh
from pasdedeux.formats.c3d import write_c3d
from pasdedeux.formats.poses2d.annotated_frames import AnnotatedFrames
from pasdedeux.formats.poses2d.annotation_csv import read_annotation_csv
from pasdedeux.formats.poses2d.cvat import write_cvat
from pasdedeux.formats.trc import write_trc
from pasdedeux.kinematics import Motion
from pasdedeux.kinematics.rotations import unitquat_from_rotvec
from pasdedeux.skeletons import BODY22, EXPI18, EXPI18_OF_BODY22
from pasdedeux.skeletons.layouts import KEYPOINT_LAYOUTS
from tests.builders.body_models import amass, body_model, npz

SAMPLES = Path(__file__).with_name("samples")

FIGURE_REST_M = {
    "pelvis": (0.0, 0.95, 0.0),
    "spine1": (0.0, 1.05, 0.0),
    "spine2": (0.0, 1.17, 0.0),
    "spine3": (0.0, 1.3, 0.0),
    "neck": (0.0, 1.45, 0.0),
    "head": (0.0, 1.6, 0.0),
    "left_hip": (0.09, 0.88, 0.0),
    "left_knee": (0.09, 0.48, 0.01),
    "left_ankle": (0.09, 0.08, 0.0),
    "left_toe": (0.1, 0.03, 0.13),
    "right_hip": (-0.09, 0.88, 0.0),
    "right_knee": (-0.09, 0.48, 0.01),
    "right_ankle": (-0.09, 0.08, 0.0),
    "right_toe": (-0.1, 0.03, 0.13),
    "left_collar": (0.06, 1.4, 0.0),
    "left_shoulder": (0.17, 1.41, 0.0),
    "left_elbow": (0.44, 1.41, 0.0),
    "left_wrist": (0.69, 1.41, 0.0),
    "right_collar": (-0.06, 1.4, 0.0),
    "right_shoulder": (-0.17, 1.41, 0.0),
    "right_elbow": (-0.44, 1.41, 0.0),
    "right_wrist": (-0.69, 1.41, 0.0),
}
"""A standing person facing +Z, arms out; its own left is +X."""


def figure_motion(num_frames: int = 12, rate_hz: float = 30.0, seed: int = 0) -> Motion:
    """Return person who lifts the left arm and knee, looks to the left, turns and walks: nothing of it is symmetric."""
    rest = np.array([FIGURE_REST_M[name] for name in BODY22.joint_names])
    offsets = np.array([rest[j] - rest[p] if p >= 0 else np.zeros(3) for j, p in enumerate(BODY22.parents)])
    rng = np.random.default_rng(seed)
    rotvec = rng.normal(0.0, 0.15, (1, BODY22.num_joints, 3)) + np.zeros((num_frames, 1, 1))
    phase = np.linspace(0.0, 1.0, num_frames)
    rotvec[:, BODY22.index("left_shoulder"), 2] += 0.9 * phase
    rotvec[:, BODY22.index("left_hip"), 0] -= 0.7 * phase
    rotvec[:, BODY22.index("neck"), 1] += 0.6
    rotvec[:, BODY22.index("pelvis"), 1] += 0.8 * phase
    root = np.stack([0.3 * phase, 0.95 + 0.0 * phase, 0.5 * phase], axis=-1)
    return Motion(
        skeleton=BODY22,
        rest_offsets_m=offsets,
        root_translation_m=root,
        local_unitquat=unitquat_from_rotvec(rotvec),
        rate_hz=rate_hz,
    )


def bvh_text(num_frames: int = 12, rate_hz: float = 30.0, seed: int = 0) -> str:
    """Return the figure as BVH in centimetres."""
    return write_bvh(figure_motion(num_frames, rate_hz, seed))


BVH_SMALL = (SAMPLES / "small.bvh").read_text()
ASF = (SAMPLES / "small.asf").read_text()
AMC = (SAMPLES / "small.amc").read_text()


def openpose_text(layout: str = "coco18", *, people: int = 1, seed: int = 0, missing: tuple[int, ...] = ()) -> str:
    """Return one OpenPose frame of plausible people; `missing` keypoints are (0, 0, 0)."""
    listed = []
    for person in range(people):
        px = person_px(layout, seed=seed) + np.array([300.0 * person, 0.0])
        rows = np.concatenate([px, np.full((len(px), 1), 0.9)], axis=1)
        rows[list(missing)] = 0.0
        listed.append({"person_id": [-1], "pose_keypoints_2d": rows.round(3).reshape(-1).tolist()})
    return json.dumps({"version": 1.3, "people": listed})


_PERSON_PX = {
    "nose": (100, 60), "neck": (100, 90), "head": (100, 60), "pelvis": (100, 190), "mid_hip": (100, 190),
    "spine": (100, 157), "chest": (100, 123),
    "left_eye": (105, 55), "right_eye": (95, 55), "left_ear": (112, 60), "right_ear": (88, 60),
    "left_shoulder": (122, 92), "left_elbow": (135, 130), "left_wrist": (150, 100),
    "right_shoulder": (78, 92), "right_elbow": (70, 132), "right_wrist": (66, 170),
    "left_hip": (112, 190), "left_knee": (120, 245), "left_ankle": (118, 300),
    "right_hip": (88, 190), "right_knee": (84, 248), "right_ankle": (82, 302),
    "left_big_toe": (126, 312), "left_small_toe": (132, 310), "left_heel": (116, 308),
    "right_big_toe": (74, 314), "right_small_toe": (68, 312), "right_heel": (84, 310),
    "upper_neck": (100, 78), "belly": (100, 140),
    "head_top": (100, 38), "mouth_left": (104, 66), "mouth_right": (96, 66),
    "left_eye_inner": (103, 55), "left_eye_outer": (108, 55), "right_eye_inner": (97, 55), "right_eye_outer": (92, 55),
    "left_pinky": (156, 92), "left_index": (152, 90), "left_thumb": (148, 92),
    "right_pinky": (64, 180), "right_index": (66, 182), "right_thumb": (68, 178),
}  # fmt: skip
"""Someone who faces the camera: the left side is on the image's right; the left hand is raised."""


def person_px(layout: str, seed: int = 0) -> np.ndarray:
    """Return the keypoints (K, 2) of a person who faces the camera, with a little noise."""
    names = KEYPOINT_LAYOUTS[layout].keypoint_names
    exact = np.array([_PERSON_PX[name] for name in names], dtype=np.float64)
    return exact + np.random.default_rng(seed).normal(0.0, 1.0, exact.shape)


def coco_text(num_frames: int = 3, people: int = 2) -> str:
    """Return COCO annotations; the right wrist of everybody is not labelled."""
    names = KEYPOINT_LAYOUTS["coco17"].keypoint_names
    annotations = []
    for frame in range(num_frames):
        for _ in range(people):
            rows = np.concatenate([person_px("coco17", seed=frame), np.full((17, 1), 2.0)], axis=1)
            rows[names.index("right_wrist")] = 0
            rows[names.index("left_wrist"), 2] = 1
            annotations.append({"image_id": 10 + frame, "keypoints": rows.round(2).reshape(-1).tolist()})
    images = [{"id": 10 + frame, "width": 640, "height": 480, "file_name": "x"} for frame in range(num_frames)]
    return json.dumps({"images": images, "annotations": annotations})


def people_of(num_frames: int, people: int, layout: str = "coco17") -> Iterator[tuple[int, int, np.ndarray]]:
    """Yield frame, person and keypoints (K, 3) with confidences 0.9; the right wrist of everybody is not detected."""
    names = KEYPOINT_LAYOUTS[layout].keypoint_names
    for frame in range(num_frames):
        for person in range(people):
            px = person_px(layout, seed=frame) + np.array([300.0 * person, 0.0])
            table = np.concatenate([px, np.full((len(px), 1), 0.9)], axis=1).round(3)
            table[names.index("right_wrist")] = 0.0
            yield frame, person, table


def result_texts(num_frames: int = 6, people: int = 2) -> dict[str, str]:
    """Return the same people as detectors write them: by tool, from what their own code writes."""
    tables = list(people_of(num_frames, people))
    flat = [(frame, person, table.reshape(-1).tolist()) for frame, person, table in tables]
    frames = [
        {
            "frame_id": frame,
            "instances": [
                {"keypoints": table[:, :2].tolist(), "keypoint_scores": table[:, 2].tolist(), "bbox_score": 0.9}
                for at, _, table in tables
                if at == frame
            ],
        }
        for frame in range(num_frames)
    ]
    return {
        "detectron2": json.dumps([{"image_id": f, "category_id": 1, "score": 1.0, "keypoints": k} for f, _, k in flat]),
        "ultralytics": json.dumps(
            [{"image_id": f"clip_{f:06d}", "category_id": 1, "keypoints": k, "score": 0.9} for f, _, k in flat]
        ),
        "alphapose": json.dumps(
            [
                {"image_id": f"{f}.jpg", "category_id": 1, "keypoints": k, "score": 3.1, "idx": [p + 1.0]}
                for f, p, k in flat
            ]
        ),
        "mmpose demo": json.dumps({"meta_info": {"dataset_name": "coco"}, "instance_info": frames}),
        "mmpose inferencer": json.dumps(frames),
    }


def image_text(tool: str, *, people: int = 2, seed: int = 0) -> str:
    """Return the people of one image as a tool writes a file for each: mmpose, mmpose demo, or ultralytics."""
    tables = [person_px("coco17", seed=seed) + np.array([300.0 * person, 0.0]) for person in range(people)]
    if tool == "ultralytics":
        box = {"x1": 50.0, "y1": 30.0, "x2": 160.0, "y2": 320.0}
        listed = [
            {"name": "person", "class": 0, "confidence": 0.9, "box": box, "track_id": 1 + person}
            | {"keypoints": {"x": px[:, 0].tolist(), "y": px[:, 1].tolist(), "visible": [0.9] * len(px)}}
            for person, px in enumerate(tables)
        ]
        return json.dumps(listed, indent=2)
    instances = [{"keypoints": px.tolist(), "keypoint_scores": [0.9] * len(px), "bbox_score": 0.9} for px in tables]
    meta = {"dataset_name": "coco", "num_keypoints": 17, "keypoint_id2name": {"0": "nose"}}
    return json.dumps({"meta_info": meta, "instance_info": instances} if tool == "mmpose demo" else instances)


def landmark_texts(num_frames: int = 6, people: int = 1, side_px: int = 400) -> dict[str, str]:
    """Return people in MediaPipe's landmarks, shares of a square image, in the forms in which programs export them."""
    names = [name.replace("big_toe", "foot_index") for name in KEYPOINT_LAYOUTS["mediapipe33"].keypoint_names]
    frames: list[list[np.ndarray]] = [[] for _ in range(num_frames)]
    for frame, _, table in people_of(num_frames, people, "mediapipe33"):
        frames[frame].append(table / (side_px, side_px, 1.0))
    points = [
        [[{"x": x, "y": y, "z": -0.1, "visibility": v} for x, y, v in person.tolist()] for person in frame]
        for frame in frames
    ]
    first = [frame[0] for frame in points]
    named = [dict(zip((name.upper() for name in names), person, strict=True)) for person in first]
    rows = [people[0].tolist() for people in frames]
    by_landmark = [
        f"{frame},{index},{name.upper()},{x},{y},0,{v}"
        for frame, row in enumerate(rows)
        for index, (name, (x, y, v)) in enumerate(zip(names, row, strict=True))
    ]
    wide = [",".join(f"{x},{y},0,{v}" for x, y, v in row) for row in rows]
    return {
        "frames": json.dumps(
            {"fps": 25, "width": side_px, "height": side_px}
            | {"frames": [{"frame_index": frame, "landmarks": person} for frame, person in enumerate(first)]}
        ),
        "people": json.dumps([{"pose_landmarks": frame} for frame in points]),
        "keypoints": json.dumps([{"frame_id": frame, "keypoints": person} for frame, person in enumerate(first)]),
        "by name": json.dumps([{"frame": frame, "landmarks": person} for frame, person in enumerate(named)]),
        "rows": "\n".join(["frame,landmark_id,landmark_name,x,y,z,visibility", *by_landmark]),
        "columns by name": "\n".join(
            [
                "frame," + ",".join(f"{name}_x,{name}_y,{name}_z,{name}_visibility" for name in names),
                *(f"{frame},{row}" for frame, row in enumerate(wide)),
            ]
        ),
        "columns by number": "\n".join([",".join(f"x{i},y{i},z{i},v{i}" for i in range(1, 34)), *wide]),
    }


def csv_text(num_frames: int = 3) -> str:
    """Return our table of annotations of one person in pair17."""
    lines = ["# layout: pair17", "# image_size: 640x480", "# rate_hz: 25", "frame,person,joint,x,y,confidence"]
    for frame in range(num_frames):
        for name, (x, y) in zip(KEYPOINT_LAYOUTS["pair17"].keypoint_names, person_px("pair17", frame), strict=True):
            lines.append(f"{frame},0,{name},{x:.3f},{y:.3f},0.8")
    return "\n".join(lines) + "\n"


def pair_csv_text(num_frames: int = 3) -> str:
    """Return the table of two people who stand in the same place."""
    first = csv_text(num_frames).splitlines()
    second = [line.replace(",0,", ",1,", 1) for line in first if line[0].isdigit()]
    return "\n".join([*first, *second, ""])


def positions_npz() -> bytes:
    """Return the figure's positions without rotations."""
    positions, _ = figure_motion().world()
    return npz(positions_m=positions, joint_names=np.array(BODY22.joint_names), rate_hz=np.array(30.0))


def write_annotation_npz(frames: AnnotatedFrames) -> bytes:
    """Return annotations as our npz, as programs of users write it."""
    stated = {"image_size_px": next(iter(frames.image_size_px.values()), None), "rate_hz": frames.rate_hz}
    return npz(
        layout=frames.layout,
        sequence=frames.sequence_id,
        frame=frames.frame,
        person=frames.person_id,
        keypoints_px=frames.keypoints_px,
        confidence=frames.confidence,
        **{name: value for name, value in stated.items() if value},
    )


def c3d_points(subjects: str = "A") -> bytes:
    """Return the figure as labelled points of a C3D file, as often as there are letters, a metre beside each other."""
    figure, _ = figure_motion().world()
    labels = [f"{subject}:{joint}" for subject in subjects for joint in BODY22.joint_names]
    people = [figure + np.array([1.0 * number, 0.0, 0.0]) for number in range(len(subjects))]
    return write_c3d(np.concatenate(people, axis=1), labels, rate_hz=30.0, facts={"CREDIT": "made up"})


def trc_text(subjects: str = "A") -> str:
    """Return the figure as markers of a TRC file, as often as there are letters, a metre beside each other."""
    figure, _ = figure_motion().world()
    people = np.stack([figure + np.array([1.0 * number, 0.0, 0.0]) for number in range(len(subjects))], axis=1)
    labels = [f"{subject}:{joint}" for subject in subjects for joint in BODY22.joint_names]
    return write_trc(people.reshape(len(figure), -1, 3), labels, rate_hz=30.0, name="made_up.trc")


_EXPI_SIDES = ("shoulder", "elbow", "wrist", "hip", "knee", "heel", "toes")
EXPI_NAMES = [
    f"{who}-{joint}"
    for who in "mf"
    for joint in ("fhead", "lhead", "rhead", "back", *(side + part for part in _EXPI_SIDES for side in "lr"))
]
"""Joints of a take of ExPI in the order that its authors read them."""


def expi_people(num_frames: int = 40) -> np.ndarray:
    """Return expi18 positions (frame, person, 18, 3) of two people who stand and sway, metres, Y up."""
    positions, _ = figure_motion().world()
    mapped = EXPI18_OF_BODY22.positions(positions[np.arange(num_frames) % len(positions)], BODY22.joint_names)
    return np.stack([mapped, mapped + np.array([0.6, 0.0, 0.1])], axis=1)


def expi_tsv(people_m: np.ndarray | None = None) -> bytes:
    """Return a take of ExPI: a line of names, then frames in millimetres, Z up, in the order of `EXPI_NAMES`."""
    people = expi_people() if people_m is None else people_m
    order = [name for name in EXPI_NAMES if name.startswith("m-")]
    ours = [EXPI18.index(_EXPI_OURS.get(name[2:], name[2:])) for name in order]
    x, y, z = np.moveaxis(people[:, :, ours], -1, 0)
    rows = 1000.0 * np.stack([x, -z, y], axis=-1).reshape(len(people), -1)
    lines = [",".join(EXPI_NAMES), *(",".join(f"{value:.4f}" for value in row) for row in rows)]
    return ("\n".join(lines) + "\n").encode()


_EXPI_OURS = {"fhead": "head", "lhead": "left_head", "rhead": "right_head"} | {
    f"{side[0]}{part}": f"{side}_{ {'heel': 'ankle', 'toes': 'toe'}.get(part, part) }"
    for side in ("left", "right")
    for part in _EXPI_SIDES
}

ROTATION_ROWS = "0 0 0 1 2 3 4 5 6\n10 20 30 0 0 0 7 8 9\n"
ROTATION_TEMPLATE = (SAMPLES / "rotation_template.bvh").read_text()

GOOD_MOTIONS: dict[str, tuple[bytes, bytes]] = {
    "bvh": (BVH_SMALL.encode(), b""),
    "asf_amc": (AMC.encode(), ASF.encode()),
    "rotation_rows": (ROTATION_ROWS.encode(), ROTATION_TEMPLATE.encode()),
    "positions_npz": (positions_npz(), b""),
    "expi": (expi_tsv(), b""),
    "c3d": (c3d_points(), b""),
    "trc": (trc_text("AB").encode(), b""),
    "smpl": (amass(), body_model()),
}
"""A good file of every format of motions, and what must lie beside it."""


def yolo_text(*, people: int = 2, seed: int = 0, has_scores: bool = True, tail: str = "") -> str:
    """Return the people of one image of 640 x 480 as YOLO writes them; the right wrist is not detected."""
    lines = []
    for frame, _, table in people_of(seed + 1, people):
        if frame == seed:
            table = table / (640.0, 480.0, 1.0)
            values = (table if has_scores else table[:, :2]).reshape(-1).tolist()
            lines.append(f"0 0.4 0.5 0.2 0.6 {' '.join(f'{value:.6f}' for value in values)}{tail}")
    return "\n".join(lines) + "\n"


GOOD_ANNOTATIONS: dict[str, dict[str, bytes]] = {
    "openpose": {f"w_{frame}_keypoints.json": openpose_text(people=2, seed=frame).encode() for frame in range(3)},
    "coco": {"c.json": coco_text().encode()},
    "image_results": {f"w_{frame}.json": image_text("mmpose", seed=frame).encode() for frame in range(3)},
    "points": {"m.json": landmark_texts()["frames"].encode()},
    "cvat": {"c.xml": write_cvat(read_annotation_csv(csv_text())).encode()},
    "yolo": {f"clip_{frame}.txt": yolo_text(seed=frame).encode() for frame in range(3)},
    "annotation_csv": {"t.csv": csv_text().encode()},
    "annotation_npz": {"a.npz": write_annotation_npz(read_annotation_csv(csv_text()))},
}
"""Good files of every format of 2D poses, by name."""
