"""Formats: readers and writers of motion and keypoint files; bytes or text in, values out, never a path."""

from pasdedeux.formats.annotated_frames import AnnotatedFrames, check_anatomy, in_pixels
from pasdedeux.formats.annotation_csv import read_annotation_csv
from pasdedeux.formats.annotation_npz import read_annotation_npz
from pasdedeux.formats.asf_amc import read_amc, read_asf
from pasdedeux.formats.bvh import read_bvh, read_bvh_header
from pasdedeux.formats.bvh_writer import write_bvh
from pasdedeux.formats.coco import read_coco
from pasdedeux.formats.detections import Footage
from pasdedeux.formats.file_format import AnnotationFormat, FileFormat, FileStart, MotionFormat, MotionHead
from pasdedeux.formats.guess import (
    AxisGuess,
    MotionGuess,
    UnitGuess,
    common_up_axis,
    guess_motion,
    guess_unit,
    guess_up_axis,
)
from pasdedeux.formats.openpose import (
    OpenPoseFrame,
    join_openpose_frames,
    openpose_frame_number,
    read_openpose_frame,
)
from pasdedeux.formats.positions_as_motion import exact_motion, motion_from_positions
from pasdedeux.formats.positions_npz import read_positions_npz
from pasdedeux.formats.registry import (
    ANNOTATION_FORMATS,
    MOTION_FORMATS,
    find_format,
    is_companion,
    read_annotations,
    recognise_format,
)
from pasdedeux.formats.rotation_rows import read_rotation_rows
from pasdedeux.formats.source_motion import UP_AXES, SourceMotion
from pasdedeux.formats.working_poses import WorkingPoses, check_layout, derive_working_poses

__all__ = [
    "ANNOTATION_FORMATS",
    "MOTION_FORMATS",
    "UP_AXES",
    "AnnotatedFrames",
    "AnnotationFormat",
    "AxisGuess",
    "FileFormat",
    "FileStart",
    "Footage",
    "MotionFormat",
    "MotionGuess",
    "MotionHead",
    "OpenPoseFrame",
    "SourceMotion",
    "UnitGuess",
    "WorkingPoses",
    "check_anatomy",
    "check_layout",
    "common_up_axis",
    "derive_working_poses",
    "exact_motion",
    "find_format",
    "guess_motion",
    "guess_unit",
    "guess_up_axis",
    "in_pixels",
    "is_companion",
    "join_openpose_frames",
    "motion_from_positions",
    "openpose_frame_number",
    "read_amc",
    "read_annotation_csv",
    "read_annotation_npz",
    "read_annotations",
    "read_asf",
    "read_bvh",
    "read_bvh_header",
    "read_coco",
    "read_openpose_frame",
    "read_positions_npz",
    "read_rotation_rows",
    "recognise_format",
    "write_bvh",
]
