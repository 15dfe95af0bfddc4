"""What draws are good for: annotations lifted to 3D, and the pairs between them."""

from __future__ import annotations

from storage_schema.columns import Table, float64, integer, text
from storage_schema.tables.common import PAIR_PLACE, positions

_PAIR = positions(
    "pair17",
    "Positions of both people, camera axes (x right, y up, z towards the camera), the middle of the pair at the origin",
    num_people=2,
)

LIFTED_PAIRS = Table(
    name="lifted_pairs",
    meaning="One row per annotated pair and method: the 3D pair it was lifted to.",
    sorted_by=("sequence_id", "frame", "person_id", "method"),
    columns=(
        *PAIR_PLACE,
        text(
            "method",
            "nearest (the nearest draw), neighbours (mean of near draws), fitted (that, fitted to the joints seen), "
            "completed (joints not seen from the draws nearest in D_I), over_time (with other frames of the video, one "
            "camera for all), or a baseline: mean_pair, lifting, lifting_ik, naive_sampling",
        ),
        integer("num_joints_seen", "Joints of the two people that were seen, of 28: without pelvis, spine and chest"),
        float64("residual_m", "Root mean square distance of the joints seen from the image", unit="m"),
        text("draw", "Reference of the nearest draw; null for baselines", is_nullable=True),
        integer("hypothesis", "View hypothesis under which that draw was seen; null for baselines", is_nullable=True),
        float64(
            "expected_error_m",
            "Mean joint error to expect, told without the truth; null but for the last of fitted, completed, over_time",
            unit="m",
            is_nullable=True,
        ),
        float64("expected_low_m", "Lower end of where 80 % of the errors are", unit="m", is_nullable=True),
        float64("expected_high_m", "Upper end", unit="m", is_nullable=True),
        _PAIR,
    ),
)

IN_BETWEENS = Table(
    name="in_betweens",
    meaning="One row per frame between two lifted annotations of a sequence and method.",
    sorted_by=("sequence_id", "frame", "person_id", "method"),
    columns=(
        *PAIR_PLACE,
        text("method", "draws (led past draws) or straight (the baseline)"),
        integer("first_frame", "Lifted frame before"),
        integer("last_frame", "Lifted frame after"),
        _PAIR,
    ),
)
