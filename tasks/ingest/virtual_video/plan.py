"""The plan of virtual video over a take."""

from __future__ import annotations

from collections.abc import Iterator

from tasks.ingest.common import INGEST
from tasks.ingest.parameters import IngestParameters
from tasks.ingest.takes.parameters import DuetParameters, TakeParameters, num_people_of
from tasks.ingest.virtual_video.parameters import UNIFORM_PITCH_DEG, VideoParameters, VirtualCameras
from tasks.stage import Shard, StageInputs
from tasks.stage.facts import Purpose


def plan_virtual_video(inputs: StageInputs, parameters: IngestParameters, take: Shard) -> Iterator[Shard]:
    """Return the shards of virtual video over a take: whole takes, and random views unless it is held out."""
    options, planned = parameters.virtual_video, take.parameters
    assert isinstance(planned, DuetParameters | TakeParameters)
    if options.takes is not None and planned.take_id not in options.takes:
        return
    cameras = options.model_dump(include=set(VirtualCameras.model_fields))
    cameras["pitch_deviation_deg"] = min(options.pitch_deviation_deg, UNIFORM_PITCH_DEG)
    num_people = num_people_of(planned.duet.name) if isinstance(planned, DuetParameters) else len(planned.persons)
    is_pair = num_people == 2
    num_random_views = options.num_random_views if is_pair and not planned.is_held_out else 0
    wanted: list[tuple[str, Purpose, int]] = [
        ("video", "video", options.num_videos),
        ("random_views", "random_views", num_random_views),
        ("detector", "video", options.num_videos if options.has_detector else 0),
    ]
    for name, purpose, count in wanted:
        if count:
            video = VideoParameters(
                purpose=purpose,
                count=count,
                take_id=planned.take_id,
                is_held_out=planned.is_held_out,
                rate_hz=parameters.rate_hz,
                leave_one_out_every=options.leave_one_out_every if purpose == "random_views" else 0,
                detector=True if name == "detector" else None,
                **cameras,
            )
            yield INGEST.shard(inputs, planned.take_id, name, video, after=(take.key,))
