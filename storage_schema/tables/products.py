"""Products: variants, models and scores."""

from __future__ import annotations

import pyarrow as pa

from storage_schema.columns import Table, array, boolean, float64, integer, text
from storage_schema.tables.common import (
    FRAME,
    MODEL_ID,
    PERSON,
    SEQUENCE_ID,
    TAKE_ID,
    TIME_S,
    VARIANT_ID,
    VERDICT,
    figures,
    positions,
    unitquats,
)

VARIANTS = Table(
    name="variants",
    meaning="One row per variant of a take, frame and person: body22 after augmentation.",
    sorted_by=("take_id", "variant_id", "frame", "person"),
    columns=(
        TAKE_ID,
        VARIANT_ID,
        FRAME,
        PERSON,
        TIME_S,
        positions("body22", "World positions"),
        unitquats(
            "body22_unitquat", "body22", "Local rotations (x, y, z, w): swing from the bones, twist from the source"
        ),
    ),
)

VARIANT_QUALITY = Table(
    name="variant_quality",
    meaning="One row per variant: its proportions, how it was solved and how good it is.",
    sorted_by=("take_id", "variant_id"),
    columns=(
        TAKE_ID,
        VARIANT_ID,
        array(
            "bone_scale",
            "Scale of each bone, (person, 22) flattened (bone = its child joint; the root's is the root height)",
            dtype=pa.float64(),
        ),
        array("uniform_scale", "Uniform scale of each person, NaN where not uniform", dtype=pa.float64()),
        integer("num_frames", "Frames solved"),
        *figures("variant_quality"),
        integer("num_warn_frames", "Frames with a figure that is a warning and none that is a failure"),
        integer("num_fail_frames", "Frames with a figure that is a failure"),
        float64(
            "estimated_gap_m",
            "Mean joint distance from the optimum by the bulk solver's last changes; null where another solver ended",
            unit="m",
            is_nullable=True,
        ),
        integer("num_iterations", "Iterations of the solver, at the coarse rate"),
        text("solver", "bulk, polished (bulk, then guaranteed descent), plain_fk (bulk failed) or model (sampled)"),
        *VERDICT,
    ),
)

VARIANT_FRAMES = Table(
    name="variant_frames",
    meaning="One row per variant of a take and frame: how good it is there.",
    sorted_by=("take_id", "variant_id", "frame"),
    columns=(TAKE_ID, VARIANT_ID, FRAME, *figures("variant_frames"), VERDICT[0]),
)

CONTACTS = Table(
    name="contacts",
    meaning="One row per frame and two parts of bodies that touch, in takes, variants and reconstructed motions; "
    "`export contacts:STUDY` makes it, it is in no store.",
    sorted_by=("origin", "frame"),
    columns=(
        text("origin", "What it is found in: poses (a take), variants or motions (reconstructed)"),
        TAKE_ID.with_meaning("Take; null for motions", is_nullable=True),
        VARIANT_ID.with_meaning("Variant; null for takes and motions", is_nullable=True),
        SEQUENCE_ID.with_meaning("Sequence; null for takes and variants", is_nullable=True),
        text("method", "How a motion was found; null for takes and variants", is_nullable=True),
        FRAME.with_meaning("Frame of the take, or of the video for motions"),
        TIME_S.with_meaning("Time from frame 0"),
        text("person", "Person of the first point: A, B, ..."),
        text("bone", "Bone of body22 that the first point lies on, by its child joint"),
        float64("share", "Where on that bone: 0 at its parent joint, 1 at its child"),
        array(
            "point_m",
            "The first point, on the axis of the bone, in the axes of exported motions",
            axes={"xyz": 3},
            unit="m",
        ),
        text("partner", "Person of the second point, maybe the same; null for an object", is_nullable=True),
        text("partner_bone", "Bone that the second point lies on; of an object its name"),
        float64("partner_share", "Where on that bone; null for an object", is_nullable=True),
        array("partner_point_m", "The second point, on the axis of its bone or object", axes={"xyz": 3}, unit="m"),
        float64("distance_m", "Distance of the two points", unit="m"),
        float64("gap_m", "Distance of the surfaces there, capsules; negative where they overlap", unit="m"),
        float64("weight", "How much of a contact it is, from 0 to 1, or as the study states it"),
        boolean("is_held", "It counts as a contact where there must be a yes or no: it has half the weight and more"),
    ),
)

CLIPS = Table(
    name="clips",
    meaning="One row per take and variant in a dataset's folder: where it lies, its side, its bodies, its verdict; "
    "`dataset write` makes it, it is in no store.",
    sorted_by=("take_id", "variant_id"),
    columns=(
        text("clip_id", "The take, of a variant take/variant"),
        TAKE_ID,
        VARIANT_ID.with_meaning("Variant; null for a take", is_nullable=True),
        text("split", "train, validation or test"),
        text("file", "File with its positions: a part of `poses` or `variants`"),
        integer("row_group", "Row group of that file that has them, and nothing else"),
        integer("num_frames", "Frames"),
        integer("num_people", "People"),
        float64("rate_hz", "Frame rate", unit="Hz"),
        text("verdict", "pass, warn, fail or not judged"),
        VERDICT[1],
        array("bone_scale", "Length of each bone beside the take's, (person, 22) flattened", dtype=pa.float64()),
        array("rest_m", "Rest pose with these bones, root at the origin, (person, 22, 3) flattened", unit="m"),
        float64("contact_rate", "Share of the frames in which a contact is held, of a variant those of its take"),
    ),
)

_NAMED_ARRAY = (
    *MODEL_ID,
    text("array_name", "Name of the array"),
    array("array_shape", "Its shape", dtype=pa.int32()),
    text("array_dtype", "Its precision, float64 or float32; values of either stand here exactly"),
    array("values", "Its values, row-major", dtype=pa.float64()),
)

MODELS = Table(
    name="models",
    meaning="One row per array of a trained model.",
    sorted_by=("split", "model", "array_name"),
    columns=_NAMED_ARRAY,
)

MODEL_STATES = Table(
    name="model_states",
    meaning="One row per array that the training of a model goes on from after a segment.",
    sorted_by=("split", "model", "array_name"),
    columns=_NAMED_ARRAY,
)

TRAINING_LOG = Table(
    name="training_log",
    meaning="One row per split, model and step of training.",
    sorted_by=("split", "model", "step", "quantity"),
    columns=(
        *MODEL_ID,
        integer("step", "Step; 0 for closed-form models"),
        text("quantity", "What was measured"),
        float64("value", "Its value"),
    ),
)

SCORES = Table(
    name="scores",
    meaning="One row per measured figure: what was measured, of which method, on what.",
    sorted_by=("topic", "metric", "method", "split", "item", "at"),
    columns=(
        text("topic", "Topic of the evaluation: takes, coverage, reconstruction, ..., as in its report"),
        text("metric", "Name of the measure"),
        text("method", "Method or density measured"),
        boolean("is_baseline", "The method is a baseline, shown for comparison"),
        text("split", "Part of the data: all, annotated, unannotated, held_out, or of a split, e.g. cross_scale test"),
        text("item", "Take, sequence, variant or model the figure is of; all where it is over everything"),
        float64("at", "Position on a curve (number of draws, scale); NaN for a single figure"),
        float64("value", "The figure"),
        text("unit", "Unit of the figure"),
        integer("count", "Number of things the figure is over"),
        float64("low", "Lower end of the figure's 95 % interval; NaN where none was estimated"),
        float64("high", "Upper end of it"),
    ),
)

VERDICTS = Table(
    name="verdicts",
    meaning="One row per partition of a stage and per topic of the evaluation: is it good, and beside what.",
    sorted_by=("stage", "partition"),
    columns=(
        text("stage", "Stage that is judged"),
        text("partition", "Partition of it; the topic where the stage is evaluation, and what of it is judged"),
        text("level", "pass, not judged, warn or fail: the worst of what was judged"),
        text("reason", "Why, in words"),
        text("figure", "The figure that matters, as people say it; empty without one"),
        float64("value", "That figure, the mean over all things; NaN without one"),
        text("unit", "Unit of the figure"),
        float64("baseline", "The same figure of the baseline; NaN without one"),
        text("baseline_name", "Name of the baseline"),
        integer("count", "Number of things that the figure is over"),
        text("thing", "What these are, in the plural"),
    ),
)
