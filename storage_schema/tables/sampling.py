"""Lifting by sampling: priors, views, seeds, draws and chains."""

from __future__ import annotations

import pyarrow as pa

from storage_schema.columns import Table, array, float64, integer, text
from storage_schema.tables.common import (
    CHAIN_ID,
    LOG_TERMS,
    PAIR_PLACE,
    SEED_INDEX,
    SEQUENCE_ID,
    TAKE_FRAME,
    TAKE_ID,
    VERDICT,
    figures,
    positions,
)

TORSO_BASIS = Table(
    name="torso_basis",
    meaning="Low-rank basis of the torso (pelvis, neck, shoulders, hips of pair17) learned from prior takes.",
    sorted_by=("component",),
    columns=(
        integer("component", "0 is the mean, then principal components by falling variance"),
        array(
            "torso_m", "Torso joints, pelvis at the origin", axes={"joint": 6, "xyz": 3}, unit="m", dtype=pa.float64()
        ),
        float64("standard_deviation_m", "Standard deviation along the component; 0 for the mean", unit="m"),
        float64("explained_variance", "Share of the variance explained; 0 for the mean"),
    ),
)

JOINT_LIMITS = Table(
    name="joint_limits",
    meaning="One row per joint angle of pair17: its allowed range.",
    sorted_by=("angle_id",),
    columns=(
        integer("angle_id", "Index of the joint angle"),
        text("joint", "Joint of pair17 the angle belongs to"),
        text("angle", "Name of the angle"),
        float64("lower_rad", "Least valid angle", unit="rad"),
        float64("upper_rad", "Greatest valid angle", unit="rad"),
        text("source", "Published table or prior takes the range came from"),
    ),
)

VIEWS = Table(
    name="views",
    meaning="One row per annotated frame of a pair and view hypothesis.",
    sorted_by=("sequence_id", "frame", "person_id", "hypothesis"),
    columns=(
        *PAIR_PLACE,
        integer("hypothesis", "Hypothesis of this annotation, from 0"),
        text("depth_rule", "How the relative depth of the roots was chosen"),
        integer("flip", "Depth flips of the two torsos: bit 0 for person A, bit 1 for person B"),
        float64("root_depth_m", "Depth of root 2 minus depth of root 1, towards the camera positive", unit="m"),
        array(
            "direction",
            "Unit coordinates (a, b, c) of the direction to the camera in the pair's local frame (i, j, k)",
            axes={"abc": 3},
            dtype=pa.float64(),
        ),
        float64("psi_rad", "Azimuth of the view in the local frame, lift eq. 4 with atan2", unit="rad"),
        float64("phi_rad", "Polar angle of the view from j, lift eq. 4", unit="rad"),
        float64("weight", "Weight of the hypothesis; the weights of one annotation sum to 1"),
        float64("trust", "Trust in the annotation's view: 1 when hypotheses agree, towards 0 as they spread"),
        array("metres_per_pixel", "Scale of each person", axes={"person": 2}, unit="m/px", dtype=pa.float64()),
    ),
)

SEEDS = Table(
    name="seeds",
    meaning="One row per seed: a 3D pose pair from which chains start.",
    sorted_by=("seed_index",),
    columns=(
        SEED_INDEX,
        text(
            "origin",
            "frame (of a take), file, draw (a file written by a restart), lifted (from 2D alone), over_time (with "
            "other frames of a video), grown (from seeds), filled (in between these)",
        ),
        TAKE_ID.with_meaning("Take it came from, else null", is_nullable=True),
        TAKE_FRAME,
        SEQUENCE_ID.with_meaning(
            "Annotated sequence it was lifted from, of a filled pair that of its first parent; else null",
            is_nullable=True,
        ),
        integer("sequence_frame", "Annotated frame of that sequence, else null", is_nullable=True),
        integer("sequence_person_id", "Person A of the annotated pair, else null", is_nullable=True),
        integer(
            "parent_seed_index", "Seed that a grown seed was lifted from, the nearest one; else null", is_nullable=True
        ),
        text(
            "made_from",
            "What a seed from a file was made from, as the file says, such as draws@key#row; else null",
            is_nullable=True,
        ),
        array(
            "filled_from", "Seeds that a filled pair is a mean of; -1 in others", axes={"parent": 7}, dtype=pa.int32()
        ),
        array("filled_weight", "Weights of the parents; NaN in other pairs", axes={"parent": 7}, dtype=pa.float64()),
        integer("generation", "Steps of growth from a seed that did not grow; 0 for those"),
        float64(
            "image_distance_m",
            "Root mean square distance of the annotated joints from the parent seen from their view; else null",
            unit="m",
            is_nullable=True,
        ),
        float64("log_prior", "Log of the prior (lift eq. 2) with the seed's own bone lengths, 0.05 m wide"),
        positions("pair17", "World positions of both people", num_people=2, dtype=pa.float64()),
    ),
)

DRAWS = Table(
    name="draws",
    meaning="One row per kept draw of a chain, or per repaired pair: where a short chain from a grown one ends.",
    sorted_by=("density", "seed_index", "chain", "draw"),
    columns=(
        *CHAIN_ID,
        integer("draw", "Index of the draw in its chain, from 0"),
        positions(
            "pair17",
            "Positions, gauge-fixed (centroid of the pair at the origin, yaw of the line between the roots 0)",
            num_people=2,
        ),
        array("parameters", "Sampled parameters", axes={"parameter": 108}, dtype=pa.float64()),
        *LOG_TERMS,
        integer("num_accepted", "Accepted proposals since the previous kept draw"),
        SEQUENCE_ID.with_meaning("Annotation nearest to the draw; null without annotations", is_nullable=True),
        integer("sequence_frame", "Frame of that annotation; null without annotations", is_nullable=True),
        integer("sequence_person_id", "Person A of that annotation; null without annotations", is_nullable=True),
        array(
            "view",
            "View under which they are nearest, unit (a, b, c) in the draw's local frame; NaN without annotations",
            axes={"abc": 3},
            dtype=pa.float64(),
        ),
        float64(
            "dissimilarity_m",
            "d_I between its image and that annotation, or what a density compares by instead, scaled to d_I; else NaN",
            unit="m",
        ),
        TAKE_ID.with_meaning("Take of the seed, else null", is_nullable=True),
    ),
)

CHAIN_STATES = Table(
    name="chain_states",
    meaning="One row per finished segment of a chain: what an exact continuation needs.",
    sorted_by=("density", "seed_index", "chain", "segment"),
    columns=(
        *CHAIN_ID,
        integer("segment", "Segment of the chain, from 0"),
        integer("num_draws", "Draws made up to the end of this segment"),
        array("parameters", "State of the chain", axes={"parameter": 108}, dtype=pa.float64()),
        *LOG_TERMS,
        text("generator_state", "State of the random generator, as JSON"),
        text("proposal_state", "State of the proposal (learned scales, context of the place), as JSON"),
    ),
)

CHAIN_INFO = Table(
    name="chain_info",
    meaning="One row per chain: how it went.",
    sorted_by=("density", "seed_index", "chain"),
    columns=(
        *CHAIN_ID,
        *figures("chain_info"),
        *VERDICT,
        text("note", "What is unusual about the annotations it was sampled with; empty when nothing is"),
    ),
)

SELECTED_PAIRS = Table(
    name="selected_pairs",
    meaning="One row per pair that `export draws:STUDY --select N` chose of draws, grown, filled pairs; in no store.",
    sorted_by=("rank",),
    columns=(
        integer("rank", "Order of choice, from 0: the first n rows are the selection of n"),
        float64("distance_m", "Distance D_C to the nearest row before; null for the first", unit="m", is_nullable=True),
        float64("weight", "Independent pairs among all that are nearer to this row than to any other"),
        text("origin", "draw (of a chain), repaired (end of a short one), grown (from a seed), filled (in between)"),
        text("reference", "Reference of that draw or seed"),
        text("density", "Density that the chain sampled; null for other pairs", is_nullable=True),
        SEED_INDEX.with_meaning("Seed the chain started from; the index of another pair itself"),
        integer("chain", "Chain of that seed; null for other pairs", is_nullable=True),
        integer("draw", "Index of the draw in its chain; null for other pairs", is_nullable=True),
        integer("parent_seed_index", "Seed or pair that a grown pair was lifted from; else null", is_nullable=True),
        SEQUENCE_ID.with_meaning("Annotation nearest to a draw, or that was lifted; else null", is_nullable=True),
        integer("sequence_frame", "Frame of that annotation, else null", is_nullable=True),
        integer("sequence_person_id", "Person A of that annotation, else null", is_nullable=True),
        float64("log_prior", "Log of the prior (lift eq. 2)"),
        text("verdict", "Verdict on the chain, or on growth as a whole: pass, warn or fail"),
        VERDICT[1],
        positions("pair17", "Positions, gauge-fixed as in `draws`", num_people=2),
    ),
)
