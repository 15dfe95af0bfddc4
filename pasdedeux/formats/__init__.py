"""Formats: readers and writers of motion and keypoint files; bytes or text in, values out, never a path."""

from pasdedeux.formats.annotated_frames import AnnotatedFrames, check_anatomy
from pasdedeux.formats.annotation_table import (
    read_annotation_csv,
    read_annotation_npz,
    write_annotation_csv,
    write_annotation_npz,
)
from pasdedeux.formats.asf_amc import AsfSkeleton, count_amc_frames, read_amc, read_asf
from pasdedeux.formats.bvh import BvhHeader, read_bvh, read_bvh_header
from pasdedeux.formats.bvh_writer import write_bvh
from pasdedeux.formats.coco import read_coco
from pasdedeux.formats.guess import (
    MotionGuess,
    guess_common_up_axis,
    guess_format,
    guess_metres_per_unit,
    guess_motion,
    guess_up_axis,
)
from pasdedeux.formats.openpose import (
    OpenPoseFrame,
    join_openpose_frames,
    openpose_frame_number,
    read_openpose_frame,
)
from pasdedeux.formats.position_table import PositionTake, read_positions_npz
from pasdedeux.formats.rotation_rows import read_rotation_rows
from pasdedeux.formats.source_motion import UP_AXES, SourceMotion
from pasdedeux.formats.working_poses import WorkingPoses, check_layout, derive_working_poses, motion_from_positions

__all__ = [
    "UP_AXES",
    "AnnotatedFrames",
    "AsfSkeleton",
    "BvhHeader",
    "MotionGuess",
    "OpenPoseFrame",
    "PositionTake",
    "SourceMotion",
    "WorkingPoses",
    "check_anatomy",
    "check_layout",
    "count_amc_frames",
    "derive_working_poses",
    "guess_common_up_axis",
    "guess_format",
    "guess_metres_per_unit",
    "guess_motion",
    "guess_up_axis",
    "join_openpose_frames",
    "motion_from_positions",
    "openpose_frame_number",
    "read_amc",
    "read_annotation_csv",
    "read_annotation_npz",
    "read_asf",
    "read_bvh",
    "read_bvh_header",
    "read_coco",
    "read_openpose_frame",
    "read_positions_npz",
    "read_rotation_rows",
    "write_annotation_csv",
    "write_annotation_npz",
    "write_bvh",
]
