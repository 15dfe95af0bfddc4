"""The plan of the ingest stage: a shard per take, virtual video over it, and a shard per source of 2D poses."""

from __future__ import annotations

from collections.abc import Sequence

from pasdedeux.errors import InputError, named
from pasdedeux.formats.poses2d.calibration import calibrated_camera, choose_cameras, read_calibration
from pasdedeux.people.video import check_one_video
from tasks.ingest.common import INGEST
from tasks.ingest.files import load_file
from tasks.ingest.film.parameters import FilmOptions
from tasks.ingest.film.run import find_videos
from tasks.ingest.parameters import IngestParameters, SkippedParameters
from tasks.ingest.poses2d.parameters import AnnotationParameters
from tasks.ingest.poses2d.resolution import FoundAnnotations, find_annotations
from tasks.ingest.takes.plan import plan_takes
from tasks.ingest.virtual_video.plan import plan_virtual_video
from tasks.stage import Shard, StageInputs


def plan(inputs: StageInputs, parameters: IngestParameters) -> list[Shard]:
    """Plan all shards of the stage, after checking every source file.

    Raises:
        InputError: A file is missing or damaged, the files of a pair do not fit, or the study lacks a needed statement;
            the message names the take and the file.
    """
    try:
        parameters.check_names()
    except ValueError as error:
        raise InputError(f"ingest: {error}") from None
    takes, shards = plan_takes(inputs, parameters)
    for take in takes:
        shards.append(take)
        shards.extend(plan_virtual_video(inputs, parameters, take))
    calibrations, found_of = _calibrations(parameters), dict[str, list[str]]()
    take_seconds = parameters.take_seconds
    for options in parameters.sources_2d:
        is_held_out, waiting = options.take_id in parameters.held_out, dict[str, str]()
        cameras: Sequence[FoundAnnotations]
        if isinstance(options, FilmOptions):
            kind, cameras = "film", find_videos(options, is_held_out=is_held_out, take_seconds=take_seconds)
        else:
            skipped, kind = waiting if options.is_watched else None, "annotations"
            cameras = find_annotations(options, is_held_out=is_held_out, skipped=skipped, take_seconds=take_seconds)
        for camera in cameras:
            planned = _calibrated(camera.parameters, calibrations.get(options.id))
            found_of.setdefault(options.id, []).append(planned.id)
            shards.append(INGEST.shard(inputs, planned.id, kind, planned, files=camera.files, notes=camera.notes))
        if waiting:
            shards.append(INGEST.shard(inputs, options.id, "skipped", SkippedParameters(skipped=waiting)))
    for source in parameters.sources_2d:
        for name in (source.id, source.camera_of) if source.camera_of else ():
            check_one_video(f"camera {name}", found_of.get(name, []))
    return shards


def _calibrations(parameters: IngestParameters) -> dict[str, tuple[str, str]]:
    """Return for each source its stated calibration, and the table of its camera in that.

    Raises:
        InputError: A file is missing or damaged, or does not fit the cameras.
    """
    calibrations: dict[str, tuple[str, str]] = {}
    for source in parameters.sources_2d:
        if source.calibration is None:
            continue
        names = [source.id, *(other.id for other in parameters.sources_2d if other.camera_of == source.id)]
        data = load_file(source.calibration).data
        with named(f"calibration of '{source.id}', {source.calibration.name}"):
            cameras, _ = choose_cameras(read_calibration(data), names)
        text = data.decode("utf-8-sig")
        calibrations |= {name: (text, camera.table) for name, camera in zip(names, cameras, strict=True)}
    return calibrations


def _calibrated(parameters: AnnotationParameters, calibration: tuple[str, str] | None) -> AnnotationParameters:
    """Return a source with its camera in a calibration.

    Raises:
        InputError: The images have another shape than those of the calibration.
    """
    if calibration is None:
        return parameters
    with named(f"camera {parameters.id}"):
        calibrated_camera(*calibration, parameters.image_size_px or parameters.video_size_px)
    return parameters.model_copy(update={"calibration": calibration})
