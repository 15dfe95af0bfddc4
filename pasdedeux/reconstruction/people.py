"""From the people of a whole video to their motions: reconstruct, put into one frame, clean up."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array
from pasdedeux.errors import InputError
from pasdedeux.formats.humanoid import HumanoidMotion
from pasdedeux.kinematics.forward import bone_lengths
from pasdedeux.plausibility.capsules import body_height_m
from pasdedeux.projections.camera import DatabaseCamera
from pasdedeux.projections.database import Database
from pasdedeux.reconstruction.body import EmbodiedMotion, embody, hold_hips
from pasdedeux.reconstruction.cleanup import clean_reconstructions
from pasdedeux.reconstruction.couples import PairDepth, PairSearcher, pair_depths
from pasdedeux.reconstruction.pitch import PitchEstimate, choose_pitch, floor_offset, sized_by_height
from pasdedeux.reconstruction.reconstruct import (
    Matches,
    Method,
    Reconstruction,
    ReconstructionOptions,
    Searcher,
    match_track,
    odd_window,
    reconstruct_track,
)
from pasdedeux.reconstruction.tracks import PersonTrack
from pasdedeux.reconstruction.world import Seen, World, estimate_world
from pasdedeux.skeletons import OP14

Integers = npt.NDArray[np.int64]


@dataclass(frozen=True)
class MethodMotions:
    """What one method made of a sequence's people.

    Args:
        name: The method; `<method>_clean` after the clean-up.
        people: Their tracks and reconstructions, camera axes.
        origin_m: What to subtract (3,) to have all of them in the sequence's own frame, see `floor_offset`.
        bodies: The whole body of each, upright axes in that frame.
    """

    name: str
    people: tuple[tuple[PersonTrack, Reconstruction], ...]
    origin_m: Array
    bodies: tuple[EmbodiedMotion, ...] = ()


@dataclass(frozen=True)
class ReconstructedTracks:
    """What all methods made of a sequence's people.

    Args:
        methods: In the order asked for; the clean-up of the last one comes last.  None when nobody could be searched.
        motions: Motions of the last by person id, upright, floor at 0: all have the same frames.
        skipped: Why the others could not be reconstructed, by person id.
        searcher: The database as the camera was thought to see it, when people were matched.
        pitch: The pitch of the camera, which says where up is.
        world: Camera, sizes and places; None when only the baseline was asked for.
    """

    methods: tuple[MethodMotions, ...]
    motions: dict[int, HumanoidMotion]
    skipped: dict[int, str]
    searcher: Searcher
    pitch: PitchEstimate
    world: World | None = None


def reconstruct_people(
    searchers: Sequence[Searcher],
    people: Sequence[PersonTrack],
    methods: Sequence[Method],
    options: ReconstructionOptions | None = None,
    *,
    has_clean_up: bool = True,
    pairs_m: npt.NDArray[np.floating] | None = None,
    camera_height_m: float | None = None,
    statures_m: Mapping[int, float] | None = None,
    pitch: PitchEstimate | None = None,
) -> ReconstructedTracks:
    """Reconstruct tracks of one sequence: one pitch for all, each by every method, all in one frame, cleaned up.

    Camera, sizes and places of all are one estimate, see `world`, from what the last method but the baseline made of
    the poses; `nearest`, the baseline, leaves everybody where their own size puts them.

    Args:
        searchers: Databases made ready, one per camera; from several the pitch that suits best is found.
        people: Tracks of people whose identities are settled.
        methods: Methods; the last one is cleaned up and gives the motions.
        options: How.
        has_clean_up: Planted feet are stilled and the floor is kept.
        pairs_m: Pairs (row, person, 14, 3) that have not seen the sequence, as `pairs.centre_pairs` gives them.
        camera_height_m: Height of the camera over the floor where it is known, which gives people their size.
        statures_m: Stature of people, by person id, where it is known; gives them their size, and the others with them.
        pitch: What is known of the camera's pitch, of one searcher; with several they are tried.
    """
    statures_m = statures_m or {}
    options = options or ReconstructionOptions()
    searcher = searchers[0]
    if len(searchers) > 1:
        pitch = choose_pitch(searchers, [one.track for one in people], options)
        searcher = searchers[pitch.index].pitched(pitch.pitch_rad)
    pitch = pitch or PitchEstimate(0, searcher.database.camera.pitch_rad)
    camera = searcher.database.camera
    skipped: dict[int, str] = {}
    matched = []
    for person in people:
        try:
            matched.append((person, match_track(searcher, person.track, options)))
        except InputError as error:
            skipped[person.person_id] = str(error)
    tried = {
        method: [
            hold_hips(reconstruct_track(searcher, person.track, method, options, matches=matches))
            for person, matches in matched
        ]
        for method in (methods if matched else ())
    }
    persons = [person for person, _ in matched]
    world = None
    fitted = [method for method in tried if method is not Method.NEAREST]
    if fitted:
        first_thought = tried[fitted[-1]]
        known = dict(statures_m)
        if camera_height_m is not None:
            for person, one in zip(persons, first_thought, strict=True):
                known.setdefault(person.person_id, _stature_m(sized_by_height(one, camera, camera_height_m)))
        world = estimate_world(
            [
                Seen(person.first_frame, one, person.track.rate_hz, known.get(person.person_id))
                for person, one in zip(persons, first_thought, strict=True)
            ],
            pitch,
            pairs=_pair_depths(searcher, [matches for _, matches in matched], persons, first_thought, pairs_m),
            camera_height_m=camera_height_m,
            is_lens_known=all(person.track.lens.is_known for person in persons),
        )
        if not pitch.is_given:
            pitch = PitchEstimate(pitch.index, world.pitch_rad, world.pitch_deviation_rad)
            camera = replace(camera, pitch_rad=world.pitch_rad)
    made = []
    for method, ones in tried.items():
        found = tuple(zip(persons, ones, strict=True))
        if world is not None and method is not Method.NEAREST:
            found = tuple((person, world.moved(number, one)) for number, (person, one) in enumerate(found))
        elif camera_height_m is not None:
            found = tuple((person, sized_by_height(one, camera, camera_height_m)) for person, one in found)
        found = sized_by_stature(found, statures_m, has_one_size=method is not Method.NEAREST)
        made.append(MethodMotions(method.value, found, floor_offset([one for _, one in found], camera)))
    if made and has_clean_up:
        last = made[-1]
        seen = [(person.first_frame, one) for person, one in last.people]
        cleaned = clean_reconstructions(seen, last.origin_m, camera, rate_hz=last.people[0][0].track.rate_hz)
        people_clean = tuple((person, one) for (person, _), one in zip(last.people, cleaned, strict=True))
        made.append(MethodMotions(f"{last.name}_clean", people_clean, last.origin_m))
    made = [_embodied(one, searcher.database, camera, options) for one in made]
    motions = _motions(made[-1]) if made else {}
    return ReconstructedTracks(tuple(made), motions, skipped, searcher, pitch, world)


def _embodied(
    made: MethodMotions, database: Database, camera: DatabaseCamera, options: ReconstructionOptions
) -> MethodMotions:
    """Give the people of a method their whole bodies."""
    upright = np.asarray(camera.camera_from_upright_rotmat)
    bodies = []
    for person, one in made.people:
        window = 1 if made.name == Method.NEAREST else odd_window(options.smoothing_s, person.track.rate_hz)
        bodies.append(embody(database, one, (one.positions_m - made.origin_m) @ upright, window=window))
    return replace(made, bodies=tuple(bodies))


def _motions(made: MethodMotions) -> dict[int, HumanoidMotion]:
    """Return the motions of a method by person id."""
    found = motions_together(
        [
            (person.first_frame, body, found.is_bridged)
            for (person, found), body in zip(made.people, made.bodies, strict=True)
        ],
        rate_hz=made.people[0][0].track.rate_hz,
    )
    return {person.person_id: one for (person, _), one in zip(made.people, found, strict=True)}


def motions_together(
    people: Sequence[tuple[int, EmbodiedMotion, npt.NDArray[np.bool_]]], *, rate_hz: float
) -> list[HumanoidMotion]:
    """Return people of one video with soles at y = 0, all from the first frame with anybody to the last.

    Args:
        people: Of each the first frame, the body in every frame from there on, upright, standing ankles at y = 0, and
            which of these frames (frame,) are bridged.
        rate_hz: Frames per second.
    """
    frames = np.arange(min(first for first, _, _ in people), max(first + len(one.pelvis_m) for first, one, _ in people))
    soles = np.mean([one.body.ankle_height_m for _, one, _ in people])
    motions = []
    for first, one, is_bridged in people:
        at = np.clip(frames - first, 0, len(is_bridged) - 1)
        whole = replace(one, pelvis_m=one.pelvis_m[at] + [0.0, soles, 0.0], unitquat=one.unitquat[at])
        is_seen = (frames - first == at) & ~is_bridged[at]
        motions.append(HumanoidMotion(whole.motion(rate_hz), int(frames[0]), is_seen))
    return motions


def sized_by_stature(
    people: Sequence[tuple[PersonTrack, Reconstruction]],
    statures_m: Mapping[int, float],
    *,
    has_one_size: bool = False,
) -> tuple[tuple[PersonTrack, Reconstruction], ...]:
    """Return reconstructions at the size that gives people their stature, as their legs tell it.

    Body and path grow together about the camera, which sees no difference.

    Args:
        people: Tracks and reconstructions, camera axes, camera at the origin.
        statures_m: Stature by person id; the others grow as these do in the mean.
        has_one_size: Everybody grows alike, so that all keep their places to each other.
    """
    own = {person.person_id: _stature_m(one) for person, one in people}
    growth = {name: stature / own[name] for name, stature in statures_m.items() if own.get(name, 0.0) > 0}
    if not growth:
        return tuple(people)
    mean = float(np.exp(np.mean(np.log(list(growth.values())))))
    sizes = {name: mean if has_one_size else growth.get(name, mean) for name in own}
    return tuple((person, one.scaled(sizes[person.person_id])) for person, one in people)


def _stature_m(found: Reconstruction) -> float:
    return float(np.median(body_height_m(OP14, bone_lengths(OP14, found.positions_m))))


def _pair_depths(
    searcher: Searcher,
    matches: Sequence[Matches],
    persons: Sequence[PersonTrack],
    found: Sequence[Reconstruction],
    pairs_m: npt.NDArray[np.floating] | None,
) -> list[PairDepth]:
    """Return what pairs that look like both say of the couples of a sequence."""
    couples = _couples(persons) if pairs_m is not None and len(pairs_m) else []
    if pairs_m is None or not couples:
        return []
    database = searcher.database
    pairs = PairSearcher.of(pairs_m, num_yaws=database.num_yaws, pitch_rad=database.camera.pitch_rad)
    depths = []
    for first, second in couples:
        one, other = ((persons[place], matches[place], found[place]) for place in (first, second))
        depths.append(pair_depths(pairs, (one, other), (first, second)))
    return [one for one in depths if one is not None]


def _couples(people: Sequence[PersonTrack]) -> list[tuple[int, int]]:
    """Return the places in `people` of those who are partners and both there."""
    place = {one.person_id: number for number, one in enumerate(people)}
    partners = [-1 if one.partner_id is None else place.get(one.partner_id, -1) for one in people]
    return [(first, second) for first, second in enumerate(partners) if first < second]
