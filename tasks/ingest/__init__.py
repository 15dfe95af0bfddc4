"""Stage `ingest`: takes with poses, and annotations with the cameras of virtual video."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from pasdedeux.errors import NobodyError
from pasdedeux.verdict import Level, Verdict
from storage_schema import ArtifactRef, Store
from tasks.ingest.common import INGEST
from tasks.ingest.film.parameters import FilmParameters
from tasks.ingest.film.run import run_film
from tasks.ingest.parameters import IngestParameters, SkippedParameters
from tasks.ingest.plan import plan
from tasks.ingest.poses2d.parameters import AnnotationParameters
from tasks.ingest.poses2d.run import run_annotations
from tasks.ingest.takes.parameters import DuetParameters, TakeParameters
from tasks.ingest.takes.run import run_duet, run_take
from tasks.ingest.virtual_video.parameters import VideoParameters
from tasks.ingest.virtual_video.run import run_virtual_video
from tasks.stage import Parameters, Shard, Stage
from tasks.stage.committing import commit
from tasks.stage.facts import SkippedFacts

__all__ = ["STAGE", "IngestParameters", "plan", "run_shard"]


def _say_skipped(shard: Shard, store: Store, parameters: SkippedParameters) -> ArtifactRef:
    """Commit only the names of files that could not be read, with the reason."""
    skipped = parameters.skipped
    words = f"{', '.join(skipped)} skipped: {next(iter(skipped.values()))}"
    facts = SkippedFacts(takes=(), skipped=tuple(skipped.values()))
    return commit(shard, store, tables={}, facts=facts, verdict=Verdict(Level.WARN, words))


def _run_film(shard: Shard, store: Store, parameters: FilmParameters) -> ArtifactRef:
    """Annotate a shot; a shot in which nobody is seen, such as a landscape between two dances, is skipped."""
    try:
        return run_film(shard, store, parameters)
    except NobodyError as error:
        return _say_skipped(shard, store, SkippedParameters(skipped={parameters.id: str(error)}))


_RUNS: Mapping[type[Parameters], Callable[[Shard, Store, Any], ArtifactRef]] = {
    DuetParameters: run_duet,
    TakeParameters: run_take,
    VideoParameters: run_virtual_video,
    AnnotationParameters: run_annotations,
    FilmParameters: _run_film,
    SkippedParameters: _say_skipped,
}


def run_shard(shard: Shard, store: Store) -> ArtifactRef:
    """Compute and commit one shard: a take, virtual video over a take, or a source of 2D poses."""
    return _RUNS[type(shard.parameters)](shard, store, shard.parameters)


STAGE = Stage(
    *INGEST,
    reads=(),
    writes=("takes", "take_quality", "poses", "objects", "annotations", "cameras", "camera_motions"),
    parameters=IngestParameters,
    plan=plan,
    run_shard=run_shard,
    meaning="Takes with poses, and 2D annotations, from files, built-in duets and virtual video",
    needs="takes, annotations or film ([[ingest.takes]], [[ingest.annotations]], [[ingest.videos]])",
)
