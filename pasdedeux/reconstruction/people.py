"""From the people of a whole video to their motions: reconstruct, put into one frame, clean up."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import combinations

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array, Flags
from pasdedeux.errors import InputError
from pasdedeux.formats.humanoid import HumanoidMotion
from pasdedeux.kinematics.forward import bone_lengths
from pasdedeux.plausibility.capsules import body_height_m
from pasdedeux.projections.camera import DatabaseCamera
from pasdedeux.projections.database import Database
from pasdedeux.reconstruction.body import EmbodiedMotion, embody, hold_hips
from pasdedeux.reconstruction.cleanup import clean_reconstructions
from pasdedeux.reconstruction.couples import pair_depths
from pasdedeux.reconstruction.lying import searchers_for
from pasdedeux.reconstruction.otherwise import doubt_of_camera, seen_otherwise
from pasdedeux.reconstruction.pitch import PitchEstimate, floor_offset, size_by_height, sized_by_height
from pasdedeux.reconstruction.reconstruct import (
    SMOOTHING_S,
    Method,
    ReconstructedTrack,
    ReconstructionOptions,
    Searcher,
    match_track,
    odd_window,
    reconstruct_track,
)
from pasdedeux.reconstruction.scene import SceneEstimate, estimate_scene
from pasdedeux.reconstruction.tracks import Track
from pasdedeux.skeletons import OP14

_MAX_CONTRADICTION, _MAX_CONTRADICTION_OF_TWO = 1.2, 1.3
"""Statures stated and by the height of the camera that differ by more contradict each other, and heights of the camera
by two statures: of 49 couples of `benchmarks.families`, 4 are more than 1.2 apart and none 1.3."""
_OTHER_PITCH_RAD, _PITCHES_RAD = float(np.deg2rad(5.0)), (float(np.deg2rad(-35.0)), float(np.deg2rad(50.0)))
"""Poses are searched again before a camera whose pitch is further from the first, in this range."""
_STATURES_M = (1.2, 2.2)
"""How tall people are whose stature nobody states."""


@dataclass(frozen=True)
class MethodMotions:
    """What one method made of a sequence's people.

    Args:
        name: The method; `<method>_clean` after the clean-up.
        people: Their reconstructions, camera axes.
        origin_m: What to subtract (3,) to have all of them in the sequence's own frame, see `floor_offset`.
        bodies: The whole body of each, upright axes in that frame.
    """

    name: str
    people: tuple[ReconstructedTrack, ...]
    origin_m: Array
    bodies: tuple[EmbodiedMotion, ...]


@dataclass(frozen=True)
class Reconstruction:
    """What all methods made of a sequence's people.

    Args:
        methods: In the order asked for; the clean-up of the last one comes last.  None when nobody could be searched.
        motions: Motions of the last by person id, upright, floor at 0: all have the same frames.
        skipped: Why the others could not be reconstructed, by person id.
        pitch: The pitch of the camera, which says where up is.
        scene: Camera, sizes and root paths; None when only the baseline was asked for.
        doubts: What was stated that contradicts itself, and where the camera would be if that is below the floor.
        otherwise: What the image of somebody may show as well, by person id, see `otherwise`.
        has_stature: The stature of one of them is stated, and nothing contradicts it.
    """

    methods: tuple[MethodMotions, ...]
    motions: dict[int, HumanoidMotion]
    skipped: dict[int, str]
    pitch: PitchEstimate
    scene: SceneEstimate | None
    doubts: tuple[str, ...] = ()
    otherwise: Mapping[int, str] = field(default_factory=dict)
    has_stature: bool = False


def reconstruct_people(
    searcher: Searcher,
    tracks: Sequence[Track],
    methods: Sequence[Method],
    options: ReconstructionOptions | None = None,
    *,
    has_clean_up: bool = True,
    pairs_m: npt.NDArray[np.floating] | None = None,
    camera_height_m: float | None = None,
    statures_m: Mapping[int, float] | None = None,
    pitch: PitchEstimate | None = None,
    on_step: Callable[[], None] = lambda: None,
) -> Reconstruction:
    """Reconstruct tracks of one sequence: one pitch for all, each by every method, all in one frame, cleaned up.

    Camera, sizes and places of all are one estimate, see `scene`, from what the last method but the baseline made of
    the poses; `nearest`, the baseline, leaves everybody where their own size puts them.

    Where the scene has a camera of quite another pitch than the poses were searched before, they are searched again
    before that one, and what is nearer to the image counts.  The first pitch stays what poses say: with that of the
    first scene, floor and sizes would count twice.

    Args:
        searcher: Database made ready.
        tracks: Tracks of people whose identities are resolved.
        methods: Methods; the last one is cleaned up and gives the motions.
        options: How.
        has_clean_up: Planted feet are stilled and the floor is kept.
        pairs_m: Pairs (row, person, 14, 3) that have not seen the sequence, as `pairs.centre_pairs` gives them.
        camera_height_m: Height of the camera over the floor where it is known, which gives people their size.
        statures_m: Stature of people, by person id, where it is known; gives them their size, and the others with them.
        pitch: Estimate of the camera's pitch; that of the searcher counts as stated.
        on_step: Called when a track is matched, and when a method has made its motion.
    """
    pitch = pitch or PitchEstimate(searcher.database.camera.pitch_rad)
    once = partial(
        _reconstruct_people,
        tracks=tracks,
        methods=methods,
        options=options or ReconstructionOptions(),
        has_clean_up=has_clean_up,
        pairs_m=pairs_m,
        camera_height_m=camera_height_m,
        statures_m=statures_m or {},
    )
    found = once(searcher, pitch=pitch, on_step=on_step)
    if found.scene is None or pitch.is_given or pitch.is_guess:
        return found
    pitch_rad = float(np.clip(pitch.pitch_rad + found.scene.pitch_off_rad, *_PITCHES_RAD))
    if abs(pitch_rad - pitch.pitch_rad) < _OTHER_PITCH_RAD:
        return found
    again = once(searcher.pitched(pitch_rad), pitch=pitch, on_step=lambda: None)
    return min(found, again, key=_distance_m)


def _distance_m(found: Reconstruction) -> float:
    """Return how far everybody's matches are from the image, summed over people."""
    return sum(float(np.nanmedian(one.score_m)) for one in found.methods[-1].people)


def _reconstruct_people(
    searcher: Searcher,
    tracks: Sequence[Track],
    methods: Sequence[Method],
    options: ReconstructionOptions,
    *,
    has_clean_up: bool,
    pairs_m: npt.NDArray[np.floating] | None,
    camera_height_m: float | None,
    statures_m: Mapping[int, float],
    pitch: PitchEstimate,
    on_step: Callable[[], None],
) -> Reconstruction:
    """Reconstruct tracks before one camera; see `reconstruct_people`."""
    camera = searcher.database.camera
    skipped: dict[int, str] = {}
    matched = []
    ready = dict(zip((track.person_id for track in tracks), searchers_for(searcher, tracks), strict=True))
    for track in tracks:
        try:
            matched.append((track, match_track(ready[track.person_id], track, options)))
        except InputError as error:
            skipped[track.person_id] = str(error)
        on_step()
    otherwise = seen_otherwise(searcher, matched)
    tried: dict[Method, tuple[ReconstructedTrack, ...]] = {}
    for method in methods if matched else ():
        for track, matches in matched:
            own = ready[track.person_id]
            one = hold_hips(reconstruct_track(own, track, method, options, matches=matches))
            tried[method] = (*tried.get(method, ()), one)
            on_step()
    scene, doubts, has_stature = None, list[str](), False
    fitted = [method for method in tried if method is not Method.NEAREST]
    if fitted:
        people = tried[fitted[-1]]
        known, doubts = _sizes_stated(people, camera, statures_m, camera_height_m)
        has_stature = not doubts and not statures_m.keys().isdisjoint(one.track.person_id for one in people)
        couples = [(matches, one) for (_, matches), one in zip(matched, people, strict=True)]
        scene = estimate_scene(
            people,
            pitch,
            pairs=[] if pairs_m is None else pair_depths(pairs_m, searcher.database, couples),
            statures_m=known,
            camera_height_m=camera_height_m,
        )
        is_lens_known = all(one.track.lens.is_known for one in people)
        if odd := doubt_of_camera(scene, is_lens_known=is_lens_known, is_height_given=camera_height_m is not None):
            otherwise = {one.track.person_id: odd for one in people} | otherwise
        if scene.camera_height_m < 0:
            doubts.append(
                f"the camera would be {scene.height_in_words}, as before a stage: if it was not, state its height "
                "(--height, in a study camera_height_m)"
            )
        if not pitch.is_given:
            # What poses and floor say of it is not independent: half of what they differ by is doubt.
            doubt = float(np.hypot(scene.pitch_deviation_rad, 0.5 * scene.pitch_off_rad))
            pitch = replace(pitch, pitch_rad=scene.pitch_rad, deviation_rad=doubt)
            camera = replace(camera, pitch_rad=scene.pitch_rad)
    made = []
    for method, found in tried.items():
        if scene is not None and method is not Method.NEAREST:
            found = tuple(scene.placed(number, one) for number, one in enumerate(found))
        elif camera_height_m is not None:
            found = tuple(sized_by_height(one, camera, camera_height_m) for one in found)
        found = sized_by_stature(found, statures_m, has_one_size=method is not Method.NEAREST)
        origin = floor_offset(found, camera)
        made.append(_embodied(method.value, found, origin, searcher.database, camera))
        if has_clean_up and method is list(tried)[-1]:
            cleaned = tuple(clean_reconstructions(found, origin, camera))
            made.append(_embodied(f"{method.value}_clean", cleaned, origin, searcher.database, camera))
    return Reconstruction(
        tuple(made),
        _motions(made[-1]) if made else {},
        skipped,
        pitch,
        scene,
        tuple(doubts),
        otherwise,
        has_stature,
    )


def _sizes_stated(
    people: Sequence[ReconstructedTrack],
    camera: DatabaseCamera,
    statures_m: Mapping[int, float],
    height_m: float | None,
) -> tuple[dict[int, float], list[str]]:
    """Return the statures that are stated or follow from the height of the camera, and what of it contradicts itself.

    All stand on one floor, so one stature gives the height of the camera, and that the stature of the others.
    """
    known, doubts = dict(statures_m), []
    # What somebody's stature is before a camera one metre above the floor.
    of_height = {one.track.person_id: size_by_height(one, camera, 1.0) * _stature_m(one) for one in people}
    of_height = {name: ratio for name, ratio in of_height.items() if np.isfinite(ratio)}
    if height_m is not None:
        for one in people:
            name = one.track.person_id
            if name not in of_height:
                continue
            by_height_m, stated_m = height_m * of_height[name], statures_m.get(name)
            tall = f"would be {by_height_m:.2f} m tall before a camera {height_m:.2f} m above the floor"
            if stated_m is None and sized_by_height(one, camera, height_m) is not one:
                known[name] = by_height_m
            elif stated_m is None:
                doubts.append(f"person {name} {tall}: that height is wrong, or the pitch")
            elif _ratio(stated_m, by_height_m) > _MAX_CONTRADICTION:
                doubts.append(f"person {name} of {stated_m:.2f} m {tall}: one of both is wrong, or the pitch")
        return known, doubts
    heights_m = {name: statures_m[name] / of_height[name] for name in of_height if name in statures_m}
    for name, other in combinations(heights_m, 2):
        if _ratio(heights_m[name], heights_m[other]) > _MAX_CONTRADICTION_OF_TWO:
            doubts.append(
                f"the camera would be {heights_m[name]:.2f} m above the floor by person {name} of "
                f"{statures_m[name]:.2f} m, and {heights_m[other]:.2f} m by person {other} of {statures_m[other]:.2f} "
                "m: one of both statures is wrong, or one of the two never stands"
            )
    if heights_m and not doubts:
        height_m = float(np.exp(np.mean(np.log(list(heights_m.values())))))
        for name in sorted(of_height.keys() - statures_m.keys()):
            if not _STATURES_M[0] <= (tall_m := height_m * of_height[name]) <= _STATURES_M[1]:
                stated = ", ".join(f"{one} of {statures_m[one]:.2f} m" for one in heights_m)
                doubts.append(f"person {name} would be {tall_m:.2f} m tall beside person {stated}: state that, too")
    return known, doubts


def _ratio(one: float, other: float) -> float:
    """Return how many times as large the larger one is."""
    return max(one / other, other / one)


def _embodied(
    name: str, people: tuple[ReconstructedTrack, ...], origin_m: Array, database: Database, camera: DatabaseCamera
) -> MethodMotions:
    """Give the people of a method their whole bodies."""
    upright = np.asarray(camera.camera_from_upright_rotmat)
    bodies = []
    for one in people:
        window = 1 if name == Method.NEAREST else odd_window(SMOOTHING_S, one.track.rate_hz)
        bodies.append(embody(database, one, (one.positions_m - origin_m) @ upright, window=window))
    return MethodMotions(name, people, origin_m, tuple(bodies))


def _motions(made: MethodMotions) -> dict[int, HumanoidMotion]:
    """Return the motions of a method by person id."""
    tracks = [one.track for one in made.people]
    people = [(one.track.first_frame, body, one.is_bridged) for one, body in zip(made.people, made.bodies, strict=True)]
    found = motions_together(people, rate_hz=tracks[0].rate_hz)
    return {track.person_id: one for track, one in zip(tracks, found, strict=True)}


def motions_together(people: Sequence[tuple[int, EmbodiedMotion, Flags]], *, rate_hz: float) -> list[HumanoidMotion]:
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
    people: Sequence[ReconstructedTrack], statures_m: Mapping[int, float], *, has_one_size: bool = False
) -> tuple[ReconstructedTrack, ...]:
    """Return reconstructions at the size that gives people their stature, as their legs tell it.

    Body and path grow together about the camera, which sees no difference.

    Args:
        people: Camera axes, camera at the origin.
        statures_m: Stature by person id; the others grow as these do in the mean.
        has_one_size: Everybody grows alike, so that all keep their places to each other.
    """
    own = {one.track.person_id: _stature_m(one) for one in people}
    growth = {name: stature / own[name] for name, stature in statures_m.items() if own.get(name, 0.0) > 0}
    if not growth:
        return tuple(people)
    mean = float(np.exp(np.mean(np.log(list(growth.values())))))
    return tuple(one.scaled(mean if has_one_size else growth.get(one.track.person_id, mean)) for one in people)


def _stature_m(found: ReconstructedTrack) -> float:
    return float(np.median(body_height_m(OP14, bone_lengths(OP14, found.positions_m))))
