"""Columns that several tables have, described once; `with_meaning` states their special meaning in a table."""

from __future__ import annotations

import json
from pathlib import Path

import pyarrow as pa

from storage_schema.columns import Column, array, float64, integer, text
from storage_schema.joints import JOINT_NAMES

TAKE_ID = text("take_id", "Take: one capture, by a name unique in a study")
TAKE_FRAME = integer("take_frame", "Frame of that take, else null", is_nullable=True)
PERSON = integer("person", "Person of the take, from 0; 0 is person A")
SEQUENCE_ID = text("sequence_id", "Sequence: what one camera saw")
PERSON_ID = integer("person_id", "Person in the sequence, the same in all frames; of virtual video that of the take")
FRAME = integer("frame", "Frame of the take or sequence, from 0")
PAIR_PLACE = (
    SEQUENCE_ID,
    FRAME,
    PERSON_ID.with_meaning("Person A of the pair: the smaller id of both"),
    integer("partner_id", "Person B of the pair: the greater id"),
)
TIME_S = float64("time_s", "Time from the start of the take or sequence", unit="s")
IMAGE_SIZE = (
    integer("image_width_px", "Width of the image", unit="px"),
    integer("image_height_px", "Height of the image", unit="px"),
)
SEED_INDEX = integer("seed_index", "Index of the seed in the study")
CHAIN_ID = (
    text("density", "Density sampled (ic, prior_only, ...), or the variant of a study's chains"),
    SEED_INDEX.with_meaning("Seed the chain started from"),
    integer("chain", "Chain of that seed"),
)
VARIANT_ID = text("variant_id", "Name of the variant, e.g. A-uniform-0.80")
MODEL_ID = (text("split", "Split the model was trained on"), text("model", "Name of the model"))
VERDICT = (
    text("verdict", "pass, warn or fail"),
    text("reason", "Why it is a warning or a failure, in words; empty where it passes"),
)


LOG_TERMS = (
    float64("log_density", "Log of the target, up to a constant"),
    float64("log_prior", "Log of the prior (lift eq. 2)"),
    float64("log_likelihood", "Log of the likelihood (lift eq. 6)"),
)


_FIGURES = Path(__file__).with_name("figures.jsonl").read_text(encoding="utf-8")


def figures(table: str) -> tuple[Column, ...]:
    """Describe the figures of a table, as they are declared where they are measured; see `tasks/rows/figures.py`."""
    rows = map(json.loads, _FIGURES.splitlines())
    return tuple(
        Column(name, meaning, pa.type_for_alias(alias), unit, is_nullable=is_nullable)
        for of, name, alias, meaning, unit, is_nullable in rows
        if of == table
    )


def positions(skeleton: str, meaning: str, *, num_people: int = 1, dtype: pa.DataType | None = None) -> Column:
    """Describe the joint positions of a working skeleton: `(joint, xyz)`, of two people `(person, joint, xyz)`."""
    return _joints(f"{skeleton}_m", skeleton, meaning, num_people, {"xyz": 3}, unit="m", dtype=dtype)


def unitquats(name: str, skeleton: str, meaning: str) -> Column:
    """Describe rotations (x, y, z, w), one for each joint of a working skeleton, `(joint, xyzw)`."""
    return _joints(name, skeleton, meaning, 1, {"xyzw": 4})


def _joints(
    name: str,
    skeleton: str,
    meaning: str,
    num_people: int,
    last: dict[str, int],
    unit: str = "",
    dtype: pa.DataType | None = None,
) -> Column:
    people = {"person": num_people} if num_people > 1 else {}
    axes = {**people, "joint": len(JOINT_NAMES[skeleton]), **last}
    return array(name, meaning, axes=axes, unit=unit, joints=skeleton, dtype=dtype)
