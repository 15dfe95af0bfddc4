"""Preview of takes: the seconds in which people are nearest to each other, instead of the first ones."""

from __future__ import annotations

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.interaction.surfaces import surface_gaps
from pasdedeux.plausibility.capsules import capsule_model
from pasdedeux.skeletons import BODY22
from tasks.ingest.common import frames_in
from tasks.ingest.parameters import IngestParameters
from tasks.ingest.plan import plan
from tasks.ingest.takes.parameters import TakeOptions
from tasks.ingest.takes.run import capture_take
from tasks.stage import StageInputs

_MOST_TAKES = 12
"""With more takes, the first seconds are shown, because finding those of most contact needs whole takes."""


def with_most_contact(parameters: IngestParameters, seconds: float) -> IngestParameters:
    """Return the section with each take of files cut to the seconds of most contact, unless frames are stated.

    Raises:
        InputError: As in planning and ingest.
    """
    if len(parameters.takes) > _MOST_TAKES:
        return parameters
    whole = parameters.model_copy(update={"take_seconds": None})
    return parameters.model_copy(update={"takes": tuple(_cut(whole, take, seconds) for take in parameters.takes)})


def _cut(whole: IngestParameters, take: TakeOptions, seconds: float) -> TakeOptions:
    if take.frames is not None or len(take.files) < 2:
        return take
    alone = {"takes": (take,), "duets": (), "pairs": {}, "annotations": (), "videos": ()}
    section = whole.model_copy(update={**alone, "held_out": (), "prior": ()})
    captured = capture_take(plan(StageInputs(manifests={}, seed=0), section)[0])
    if len(captured.people_m) <= seconds * captured.rate_hz:
        return take
    start_s = nearest_seconds(captured.people_m[:, :2], captured.rate_hz, seconds)
    own_hz = captured.people[0].rate_hz
    first = round(start_s * own_hz)
    return take.model_copy(update={"frames": (first, first + frames_in(seconds, own_hz))})


def nearest_seconds(pair_m: Array, rate_hz: float, seconds: float) -> float:
    """Return the start of the seconds in which the surfaces of two people are nearest to each other.

    Args:
        pair_m: body22 (frame, person=2, 22, 3), metres.
        rate_hz: Frames per second.
        seconds: Duration; the first of several equally near spans is taken.
    """
    gaps = surface_gaps(pair_m, capsule_model(BODY22).radii_of(pair_m), BODY22).gap_m.min(axis=(1, 2))
    count = max(1, round(seconds * rate_hz))
    sums = np.concatenate([[0.0], np.cumsum(np.maximum(gaps, 0.0))])
    away = np.round(sums[count:] - sums[:-count], 6)
    return float(np.argmin(away) / rate_hz)
