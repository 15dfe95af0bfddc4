"""Reconstruct the people of one video before one camera: match, fit, place, give them bodies, clean up."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array
from pasdedeux.cameras.pinhole import PinholeCamera
from pasdedeux.errors import InputError
from pasdedeux.formats.humanoid import HumanoidMotion
from pasdedeux.projections.database import Database, DatabaseCamera
from pasdedeux.reconstruction.ambiguity import doubt_of_camera, seen_otherwise
from pasdedeux.reconstruction.body import EmbodiedMotion, embody, hold_hips, motions_together, soles_m
from pasdedeux.reconstruction.cleanup import clean_reconstructions
from pasdedeux.reconstruction.couples import pair_depths
from pasdedeux.reconstruction.lying import searchers_for
from pasdedeux.reconstruction.matching import Matches, Method, Searcher, match_track, odd_window
from pasdedeux.reconstruction.pitch import PitchEstimate, floor_offset
from pasdedeux.reconstruction.reconstruct import SMOOTHING_S, ReconstructedTrack, reconstruct_track
from pasdedeux.reconstruction.scene import SceneEstimate, estimate_scene
from pasdedeux.reconstruction.sizes import sized_by_height, sized_by_stature, statures_implied
from pasdedeux.reconstruction.tracks import Track

_OTHER_PITCH_RAD, _PITCHES_RAD = float(np.deg2rad(5.0)), (float(np.deg2rad(-35.0)), float(np.deg2rad(50.0)))
"""Smallest difference between the pitches of scene and search for a second match, and the range of its pitch."""


@dataclass(frozen=True)
class SequenceOptions:
    """Settings of the reconstruction of people.

    Args:
        methods: Each gives a motion; that of the last is cleaned up and written.
        has_clean_up: Keep planted feet still and people above the floor.
        statures_m: Known statures by person id; they also set the sizes of the others.
    """

    methods: Sequence[Method] = (Method.FIT,)
    has_clean_up: bool = True
    statures_m: Mapping[int, float] = field(default_factory=dict)


@dataclass(frozen=True)
class MethodMotions:
    """The people of a sequence by one method.

    Args:
        name: The method; `<method>_clean` after the clean-up.
        people: Their tracks, camera axes.
        origin_m: Origin of the sequence's own frame (3,), to subtract from positions, see `floor_offset`.
        bodies: The whole body of each person, upright axes in that frame.
    """

    name: str
    people: tuple[ReconstructedTrack, ...]
    origin_m: Array
    bodies: tuple[EmbodiedMotion, ...]


@dataclass(frozen=True)
class ReconstructedPeople:
    """The people of a sequence by all methods.

    Args:
        methods: In the order asked for, then the clean-up of the last one.  Empty if nobody could be matched.
        motions: Motions of the last method by person id, upright, floor at 0, all over the same frames.
        skipped: Reasons, by person id, why people could not be reconstructed.
        pitch: The pitch of the camera, which gives the upright axis.
        scene: Camera, sizes and root paths; None if only the baseline was asked for.
        doubts: Warnings: contradictory statements, or a camera found below the floor.
        otherwise: Warnings about ambiguous images by person id, see `ambiguity`.
        has_stature: Whether the stature of somebody is stated, without contradiction.
    """

    methods: tuple[MethodMotions, ...]
    motions: dict[int, HumanoidMotion]
    skipped: dict[int, str]
    pitch: PitchEstimate
    scene: SceneEstimate | None
    doubts: tuple[str, ...] = ()
    otherwise: Mapping[int, str] = field(default_factory=dict)
    has_stature: bool = False

    @property
    def camera_from_upright_rotmat(self) -> Array:
        """How the camera is pitched (3, 3)."""
        return np.asarray(DatabaseCamera(self.pitch.pitch_rad).camera_from_upright_rotmat)

    @property
    def camera(self) -> PinholeCamera:
        """The camera in the frame of the motions: upright, soles at y = 0.  For film, that of the steady image.

        There must be at least one method.
        """
        motions, rotmat = self.methods[-1], self.camera_from_upright_rotmat
        lens = motions.people[0].track.lens
        width, height = (max(round(2.0 * side), 1) for side in lens.principal_point_px)
        return PinholeCamera(
            focal_px=(1.0 if self.scene is None else self.scene.lens_factor) * lens.focal_px,
            principal_point_px=np.array(lens.principal_point_px),
            camera_from_world_rotmat=rotmat,
            position_m=-motions.origin_m @ rotmat + [0.0, soles_m(motions.bodies), 0.0],
            image_size_px=(width, height),
        )

    @property
    def camera_facts(self) -> dict[str, Array]:
        """Values of the camera by name, as files of motion store them."""
        camera = self.camera
        return {
            "camera_position_m": camera.position_m,
            "camera_from_world_rotmat": camera.camera_from_world_rotmat,
            "camera_focal_px": np.array(camera.focal_px),
            "camera_principal_point_px": camera.principal_point_px,
        }


def reconstruct_people(
    searcher: Searcher,
    tracks: Sequence[Track],
    options: SequenceOptions | None = None,
    *,
    pitch: PitchEstimate | None = None,
    camera_height_m: float | None = None,
    pairs_m: npt.NDArray[np.floating] | None = None,
    on_step: Callable[[], None] = lambda: None,
) -> ReconstructedPeople:
    """Reconstruct the people of one video by every method, in one frame, and clean up the last.

    Camera, sizes and places are estimated jointly, see `scene`, from the poses of the last method other than the
    baseline `nearest`, which leaves every person at the distance that follows from their size.

    If the pitch of the scene differs much from that of the search, poses are matched again under the new pitch, and the
    result nearer to the image is kept.  The first pitch remains the prior: with the pitch of the first scene, floor and
    sizes would count twice.

    Args:
        searcher: Prepared database.
        tracks: Tracks of people whose identities are resolved.
        options: Methods, clean-up and statures.
        pitch: Estimate of the camera's pitch; by default that of the searcher, as if stated.
        camera_height_m: Height of the camera over the floor, if known; it sets the sizes of people.
        pairs_m: Pairs (row, person, 14, 3) that have not seen the sequence, as `pairs.centre_pairs` gives them.
        on_step: Called after each track is matched, and after each method.
    """
    options = options or SequenceOptions()
    pitch = pitch or PitchEstimate(searcher.database.camera.pitch_rad)
    first = _before_camera(searcher, tracks, options, pitch, camera_height_m, pairs_m, on_step)
    if first.scene is None or pitch.is_given or pitch.is_guess:
        return first
    pitch_rad = float(np.clip(pitch.pitch_rad + first.scene.pitch_off_rad, *_PITCHES_RAD))
    if abs(pitch_rad - pitch.pitch_rad) < _OTHER_PITCH_RAD:
        return first
    again = _before_camera(
        searcher.pitched(pitch_rad), tracks, options, pitch, camera_height_m, pairs_m, on_step=lambda: None
    )
    return again if _is_nearer(again, first) else first


def _is_nearer(people: ReconstructedPeople, others: ReconstructedPeople) -> bool:
    """Tell whether the matches of `people` are nearer to the image, on average over the people in both results."""
    distances = [
        {track.person_id: float(np.nanmedian(track.score_m)) for track in result.methods[-1].people}
        for result in (people, others)
        if result.methods
    ]
    if len(distances) < 2:
        return False
    common = distances[0].keys() & distances[1].keys()
    return sum(distances[0][name] - distances[1][name] for name in common) < 0.0


def _before_camera(
    searcher: Searcher,
    tracks: Sequence[Track],
    options: SequenceOptions,
    pitch: PitchEstimate,
    camera_height_m: float | None,
    pairs_m: npt.NDArray[np.floating] | None,
    on_step: Callable[[], None],
) -> ReconstructedPeople:
    """Reconstruct tracks with the matches under one pitch; see `reconstruct_people`."""
    database = searcher.database
    matched, skipped = _match(searcher, tracks, on_step)
    by_method: dict[Method, tuple[ReconstructedTrack, ...]] = {}
    for method in options.methods if matched else ():
        by_method[method] = ()
        for ready, matches, track in matched:
            posed = hold_hips(reconstruct_track(ready, track, method, matches=matches))
            by_method[method] = (*by_method[method], posed)
            on_step()
    fitted = [method for method in by_method if method is not Method.NEAREST]
    otherwise = seen_otherwise(searcher, [(track, matches) for _, matches, track in matched])
    scene, doubts, camera, has_stature = None, list[str](), database.camera, False
    if fitted:
        people = by_method[fitted[-1]]
        known_m, doubts = statures_implied(people, camera, options.statures_m, camera_height_m)
        has_stature = not doubts and any(track.person_id in options.statures_m for track in people)
        couples = [(matches, track) for (_, matches, _), track in zip(matched, people, strict=True)]
        scene = estimate_scene(
            people,
            pitch,
            pairs=[] if pairs_m is None else pair_depths(pairs_m, database, couples),
            statures_m=known_m,
            camera_height_m=camera_height_m,
        )
        is_lens_known = all(track.track.lens.is_known for track in people)
        if odd := doubt_of_camera(scene, is_lens_known=is_lens_known, is_height_given=camera_height_m is not None):
            otherwise = {track.person_id: odd for track in people} | otherwise
        if scene.camera_height_m < 0:
            doubts.append(
                f"the camera would be {scene.height_in_words}, as before a stage: if it was not, state its height "
                "(--height, in a study camera_height_m)"
            )
        if not pitch.is_given:
            # The estimates by poses and by the floor are not independent: half of their difference counts as deviation.
            doubt_rad = float(np.hypot(scene.pitch_deviation_rad, 0.5 * scene.pitch_off_rad))
            pitch = replace(pitch, pitch_rad=scene.pitch_rad, deviation_rad=doubt_rad)
            camera = replace(camera, pitch_rad=scene.pitch_rad)
    methods: list[MethodMotions] = []
    for method, people in by_method.items():
        if scene is not None and method is not Method.NEAREST:
            people = tuple(scene.placed(number, track) for number, track in enumerate(people))
        elif camera_height_m is not None:
            people = tuple(sized_by_height(track, camera, camera_height_m) for track in people)
        people = sized_by_stature(people, options.statures_m, has_one_size=method is not Method.NEAREST)
        is_cleaned = options.has_clean_up and method is list(by_method)[-1]
        methods += _finished(method.value, people, database, camera, is_cleaned=is_cleaned)
    motions = _motions(methods[-1]) if methods else {}
    return ReconstructedPeople(tuple(methods), motions, skipped, pitch, scene, tuple(doubts), otherwise, has_stature)


def place_people(
    first: ReconstructedPeople,
    people: Sequence[ReconstructedTrack],
    pitch: PitchEstimate,
    lens_factor: float,
    database: Database,
    options: SequenceOptions,
) -> ReconstructedPeople:
    """Return people also seen by other cameras, in places and poses from all cameras.

    Args:
        first: The people by the first camera alone; there must be a method and a scene.
        people: Those of them also seen by others, with the poses of all cameras, in axes of the first.
        pitch: Pitch of the first camera.
        lens_factor: Its focal length over the assumed one.
        database: Poses that complete the bodies.
        options: Clean-up.
    """
    assert first.scene is not None
    camera, name = replace(database.camera, pitch_rad=pitch.pitch_rad), first.methods[-1].name
    methods = _finished(name, tuple(map(hold_hips, people)), database, camera, is_cleaned=options.has_clean_up)
    shown = {person.person_id for person in people}
    skipped = dict.fromkeys(first.motions.keys() - shown, "no other camera shows this person")
    scene = replace(
        first.scene, pitch_rad=pitch.pitch_rad, pitch_deviation_rad=pitch.deviation_rad, lens_factor=lens_factor
    )
    return replace(
        first,
        methods=tuple(methods),
        motions=_motions(methods[-1]),
        skipped={**first.skipped, **skipped},
        pitch=pitch,
        scene=scene,
        doubts=(),
        otherwise={},
    )


def _finished(
    name: str, people: tuple[ReconstructedTrack, ...], database: Database, camera: DatabaseCamera, *, is_cleaned: bool
) -> list[MethodMotions]:
    """Return the motions of a method with bodies, and those after the clean-up."""
    origin_m = floor_offset(people, camera)
    methods = [_embodied(name, people, origin_m, database, camera)]
    if is_cleaned:
        people = tuple(clean_reconstructions(people, origin_m, camera))
        methods.append(_embodied(f"{name}_clean", people, origin_m, database, camera))
    return methods


def _match(
    searcher: Searcher, tracks: Sequence[Track], on_step: Callable[[], None]
) -> tuple[list[tuple[Searcher, Matches, Track]], dict[int, str]]:
    """Return tracks with their searchers and matches, and reasons by person id why others could not be matched."""
    matched, skipped = [], {}
    for ready, track in zip(searchers_for(searcher, tracks), tracks, strict=True):
        try:
            matched.append((ready, match_track(ready, track), track))
        except InputError as error:
            skipped[track.person_id] = str(error)
        on_step()
    return matched, skipped


def _embodied(
    name: str, people: tuple[ReconstructedTrack, ...], origin_m: Array, database: Database, camera: DatabaseCamera
) -> MethodMotions:
    """Return the motions of a method with whole bodies."""
    upright = camera.camera_from_upright_rotmat
    bodies = []
    for person in people:
        window = 1 if name == Method.NEAREST else odd_window(SMOOTHING_S, person.track.rate_hz)
        bodies.append(embody(database, person, (person.positions_m - origin_m) @ upright, window=window))
    return MethodMotions(name, people, origin_m, tuple(bodies))


def _motions(method: MethodMotions) -> dict[int, HumanoidMotion]:
    """Return the motions of a method by person id."""
    people = [
        (person.track.first_frame, body, person.is_bridged)
        for person, body in zip(method.people, method.bodies, strict=True)
    ]
    motions = motions_together(people, rate_hz=method.people[0].track.rate_hz)
    return {person.person_id: motion for person, motion in zip(method.people, motions, strict=True)}
