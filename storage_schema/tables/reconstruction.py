"""Projection database and the motions reconstructed with it."""

from __future__ import annotations

import pyarrow as pa

from storage_schema.columns import Table, array, boolean, float64, integer, text
from storage_schema.tables.common import FRAME, PERSON, PERSON_ID, SEQUENCE_ID, TAKE_ID, TIME_S, positions, unitquats

PROJECTIONS = Table(
    name="projections",
    meaning="One row per pose; its projections at every yaw step are numbered row * num_yaws + yaw index.",
    sorted_by=("origin", "take_id"),
    columns=(
        text("origin", "take or draw"),
        TAKE_ID.with_meaning("Take the pose comes from; for a draw the take of its seed"),
        PERSON,
        FRAME.with_meaning("Frame at the database's rate; the row of the draw for draws"),
        integer("partner_row", "Row of this table with the other person of the frame", is_nullable=True),
        boolean("is_sequence_start", "No previous frame of the same motion in the row above"),
        positions("op14", "Proportions retargeted, mid-hip at the origin, body facing +Z"),
        unitquats(
            "op14_unitquat",
            "op14",
            "Rotation (x, y, z, w) of the bone that ends in the joint against the bone before it, at rest in a T-pose "
            "facing +Z; the neck carries the frame of the body, heading removed",
        ),
        unitquats(
            "body22_unitquat",
            "body22",
            "Local rotations (x, y, z, w) from the standing T-pose, heading removed; draws, which are positions of "
            "pair17, have a straight back and feet square to the shanks, variants and sources of positions bones that "
            "only swing",
        ),
        float64("heading_rad", "Heading removed: yaw of the body in its take", unit="rad"),
        array("root_translation_m", "World position of the mid-hip in its take", axes={"xyz": 3}, unit="m"),
        array(
            "joint_radius_m",
            "Horizontal distance of each joint from the mid-hip axis",
            axes={"joint": 14},
            unit="m",
            joints="op14",
        ),
    ),
)

PROJECTION_CLUSTERS = Table(
    name="projection_clusters",
    meaning="One row per cluster of the database's projections, for the search of Yiannakides et al. 2019; projections "
    "are numbered through all parts of the database, in the order in which the manifest names them.",
    columns=(
        integer("representative", "Number of the projection nearest to the cluster's centroid"),
        array("members", "Numbers of the cluster's projections, ascending", dtype=pa.int32()),
    ),
)

MOTIONS = Table(
    name="motions",
    meaning="One row per sequence, method, person and frame: the reconstructed motions.",
    sorted_by=("sequence_id",),
    columns=(
        SEQUENCE_ID,
        PERSON_ID,
        FRAME,
        TIME_S,
        text("method", "How the motion was found: nearest, published, window, viterbi or fit"),
        positions(
            "op14",
            "Positions, camera axes (x right, y up, z towards the camera); the origin lies under the people of the "
            "first frame, on the floor that the lowest ankle stands on",
        ),
        unitquats(
            "op14_unitquat",
            "op14",
            "Rotation (x, y, z, w) of the bone that ends in the joint against the bone before it, at rest in a T-pose "
            "facing the camera; the neck carries the frame of the body",
        ),
        positions("body22", "The whole body through the joints of op14, bones constant, in the same axes"),
        unitquats(
            "body22_unitquat",
            "body22",
            "Local rotations (x, y, z, w) from the standing T-pose facing the camera; spine, head and feet come from "
            "the matched pose and are bent to the joints of op14",
        ),
        array("root_translation_m", "Position of the mid-hip", axes={"xyz": 3}, unit="m"),
        float64("metres_per_pixel", "Scale of the person in the image that was estimated", unit="m/px"),
        float64("yaw_rad", "Yaw of the matched projection; NaN where bridged", unit="rad"),
        float64("score_m", "Mean 2D distance per seen joint to the matched projection; NaN where bridged", unit="m"),
        text("match_take_id", "Take of the matched pose; empty where bridged"),
        integer("match_frame", "Frame of the matched pose in the database; -1 where bridged"),
        integer("num_joints_seen", "Joints seen in this frame"),
        boolean("is_bridged", "Nothing was seen in this frame; the pose is interpolated"),
    ),
)
