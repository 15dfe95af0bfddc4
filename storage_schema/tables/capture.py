"""What came in: takes and their 3D poses, 2D annotations, and the cameras of virtual video."""

from __future__ import annotations

import pyarrow as pa

from storage_schema.columns import Table, array, boolean, float64, integer, text, text_list
from storage_schema.tables.common import (
    FRAME,
    IMAGE_SIZE,
    PERSON,
    PERSON_ID,
    SEQUENCE_ID,
    TAKE_FRAME,
    TAKE_ID,
    TIME_S,
    VERDICT,
    figures,
    positions,
    unitquats,
)

TAKES = Table(
    name="takes",
    meaning="One row per take and person: where the motion came from and the skeleton it came with.",
    sorted_by=("take_id", "person"),
    columns=(
        TAKE_ID,
        PERSON,
        text("source_name", "File name (no folder) or built-in duet the motion was read from"),
        text("source_sha256", "sha256 of the source's bytes; of the parameters for a built-in duet"),
        text("source_format", "bvh, asf_amc, rotation_rows, positions_npz, expi or duet"),
        integer("num_persons", "People in this take"),
        integer("num_frames", "Frames after resampling to the study's rate"),
        float64("rate_hz", "Frame rate of the poses", unit="Hz"),
        float64("source_rate_hz", "True frame rate of the source", unit="Hz"),
        float64("metres_per_unit", "Length of one unit of the source file", unit="m"),
        text("up_axis", "Axis of the source file that points up: x, y, z, or with a minus"),
        text("layout", "Name of the joint mapping that derived the working skeletons"),
        boolean("is_position_only", "The source had no rotations: local rotations are swing only"),
        boolean("is_held_out", "The take is kept for evaluation and never matched against"),
        text_list("joint_names", "Joints of the source's own skeleton"),
        array("joint_parents", "Parent index of each source joint, -1 for the root", dtype=pa.int32()),
        array("rest_offset_m", "Offset of each source joint from its parent at rest, (joint, 3) flattened", unit="m"),
        array(
            "body22_weight",
            "Weights (22, joint) flattened that derive body22: x_b = sum of weight[b, i] x_i + R_i offset[b, i] over "
            "the source joints i, which lie at x_i with world rotations R_i",
        ),
        array("body22_offset_m", "The offsets of that sum, (22, joint, 3) flattened; mostly zero", unit="m"),
        array(
            "body22_rest_m",
            "Working skeleton body22 in the source's rest pose, root at the origin",
            axes={"joint": 22, "xyz": 3},
            unit="m",
            joints="body22",
        ),
    ),
)

TAKE_QUALITY = Table(
    name="take_quality",
    meaning="One row per take and person: whether the capture is what people can do, at its own frame rate.",
    sorted_by=("take_id", "person"),
    columns=(TAKE_ID, PERSON, *figures("take_quality"), *VERDICT),
)

POSES = Table(
    name="poses",
    meaning="One row per take, person and frame: the source's own rotations and the working skeletons' positions.",
    sorted_by=("take_id", "person", "frame"),
    columns=(
        TAKE_ID,
        PERSON,
        FRAME.with_meaning("Frame of the take at the study's rate, from 0"),
        TIME_S,
        array("root_translation_m", "World position of the source's root", axes={"xyz": 3}, unit="m"),
        array("local_unitquat", "Local unit quaternions (x, y, z, w) of the source's joints, (joint, 4) flattened"),
        positions("pair17", "World positions"),
        positions("op14", "World positions"),
        positions("body22", "World positions"),
        unitquats(
            "body22_world_unitquat",
            "body22",
            "World rotation (x, y, z, w) from the rest pose of the source joint that carries each body22 joint",
        ),
    ),
)

OBJECTS = Table(
    name="objects",
    meaning="One row per take, object and frame: what people handle, capsules that move as they were captured.",
    sorted_by=("take_id", "object", "frame"),
    columns=(
        TAKE_ID,
        text("object", "Name of the capsule"),
        FRAME.with_meaning("Frame of the take at the study's rate, from 0"),
        array("ends_m", "World positions of both ends of its axis", axes={"end": 2, "xyz": 3}, unit="m"),
        float64("radius_m", "Its radius", unit="m"),
    ),
)

ANNOTATIONS = Table(
    name="annotations",
    meaning="One row per sequence, frame and person: 2D keypoints in pixels as given, and in the working skeletons.",
    sorted_by=("sequence_id", "frame", "person_id"),
    columns=(
        SEQUENCE_ID,
        FRAME,
        PERSON_ID,
        integer(
            "partner_id",
            "Person of the sequence that this one is paired with, by nearness over time; else null",
            is_nullable=True,
        ),
        integer("source_person_id", "Person as the source numbers them; null where it does not", is_nullable=True),
        TIME_S,
        boolean("is_key", "The annotation is one of the annotated set; false for frames kept only for velocity"),
        boolean("is_virtual", "Made by projecting a take through a virtual camera"),
        boolean("is_held_out", "Of a held-out take, or left out (leave_one_out_every): evaluated, never learned from"),
        TAKE_ID.with_meaning(
            "Take seen in virtual video, or named by the study for its own video; else null", is_nullable=True
        ),
        TAKE_FRAME,
        text("layout", "Keypoint layout: coco17, coco18, coco23, body25, halpe26, mediapipe33, pair17 or op14"),
        array(
            "keypoints_px",
            "Keypoints of that layout, (keypoint, 2) flattened; NaN where not detected or masked as a fault",
            unit="px",
        ),
        array("keypoint_confidence", "Confidence of each keypoint as given; 0 where not detected or masked"),
        array("pair17_px", "Keypoints; NaN where missing", axes={"joint": 17, "xy": 2}, unit="px", joints="pair17"),
        array("pair17_confidence", "Confidence; 0 where missing", axes={"joint": 17}, joints="pair17"),
        array("op14_px", "Keypoints; NaN where missing", axes={"joint": 14, "xy": 2}, unit="px", joints="op14"),
        array("op14_confidence", "Confidence; 0 where missing", axes={"joint": 14}, joints="op14"),
        *(column.with_meaning(f"{column.meaning}, null when unknown", is_nullable=True) for column in IMAGE_SIZE),
        float64(
            "focal_px",
            "Focal length of the camera as the source states it, null when unknown, and for virtual video",
            unit="px",
            is_nullable=True,
        ),
    ),
)

CAMERA_MOTIONS = Table(
    name="camera_motions",
    meaning="One row per frame of film whose camera turns or zooms, beside its typical direction and zoom.",
    sorted_by=("sequence_id", "frame"),
    columns=(
        SEQUENCE_ID,
        FRAME,
        array(
            "steady_from_image",
            "Homography from pixels of the frame to those of the steady image, in which reconstruction works",
            axes={"row": 3, "column": 3},
            dtype=pa.float64(),
        ),
        array(
            "displacement_px",
            "Where the middle of the frame is in the steady image, from its middle: right by pan, down by tilt",
            axes={"xy": 2},
            unit="px",
            dtype=pa.float64(),
        ),
        float64("roll_rad", "How far the steady image is turned against the frame, clockwise", unit="rad"),
        float64("zoom", "Magnification beside the steady image"),
        *IMAGE_SIZE,
    ),
)

CAMERAS = Table(
    name="cameras",
    meaning="One row per sequence of virtual video: the true camera and the take it saw.",
    sorted_by=("sequence_id",),
    columns=(
        SEQUENCE_ID,
        TAKE_ID,
        boolean("is_held_out", "The take is held out"),
        float64("rate_hz", "Frame rate of the sequence", unit="Hz"),
        *IMAGE_SIZE,
        float64("focal_px", "Focal length of the pinhole", unit="px"),
        array("principal_point_px", "Principal point", axes={"xy": 2}, unit="px", dtype=pa.float64()),
        float64("distance_m", "Distance from the camera to the point it looks at", unit="m"),
        float64("yaw_rad", "Azimuth of the camera about +Y; 0 on +Z", unit="rad"),
        float64("pitch_rad", "Elevation of the camera above the horizontal", unit="rad"),
        array("camera_position_m", "World position of the camera", axes={"xyz": 3}, unit="m", dtype=pa.float64()),
        array(
            "camera_from_world_rotmat",
            "Rotation from world to camera axes (x right, y up, z towards the camera)",
            axes={"row": 3, "column": 3},
            dtype=pa.float64(),
        ),
        float64("noise_px", "Standard deviation of the pixel noise added", unit="px"),
        float64("occlusion", "Share of joints hidden"),
    ),
)
