"""Reconstruct one person as frames arrive: match, choose with a fixed lag, fit, filter, clean up.

Scale and place follow from the last frames.  Each frame is searched once, and its yaws are refined between the steps.
Viterbi chooses among the candidates, the pose is fitted to a few frames of the image, a 1-euro filter smooths rotations
and root, and planted feet are kept still.  Bones are learned from the first frames of a person, whose poses are held
back and made again with these bones, so that bones never change.
"""

from __future__ import annotations

from collections import deque
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import chain, starmap
from statistics import median

import numpy as np
from pydantic import Field

from pasdedeux.arrays import Array, Integers
from pasdedeux.errors import InputError
from pasdedeux.kinematics.rotations import multiply
from pasdedeux.plausibility.capsules import body_height_m
from pasdedeux.projections.retarget import REFERENCE_LENGTHS_M, mid_hip
from pasdedeux.projections.scale import match_scale, place_track
from pasdedeux.reconstruction.body import REFERENCE_HIP_WIDTH_M, Bends, BodyBones, bends_of, body_with_bones, pose_body
from pasdedeux.reconstruction.body_kernels import held_hips
from pasdedeux.reconstruction.bones import bone_rotations, place_bone_rotations
from pasdedeux.reconstruction.live.cleanup import LiveCleanUp, LiveFloor
from pasdedeux.reconstruction.live.window_fit import MIN_NOISE_M, LiveFrame, WindowFit
from pasdedeux.reconstruction.matching import MIN_JOINTS, Searcher
from pasdedeux.reconstruction.proportions import estimate_proportions, retarget_image
from pasdedeux.reconstruction.rays import camera_turns, straighten_rays, turn_with_camera
from pasdedeux.reconstruction.smoothing import OneEuro, OneEuroFilter
from pasdedeux.reconstruction.temporal import FixedLagViterbi
from pasdedeux.reconstruction.tracks import Lens
from pasdedeux.reconstruction.yaw import refine_yaws
from pasdedeux.settings import Settings
from pasdedeux.skeletons import OP14

_LEFT_HIP, _RIGHT_HIP = OP14.index("left_hip"), OP14.index("right_hip")

NUM_CANDIDATES = 20
"""Number of candidates per frame."""
PROPORTIONS_EVERY = 15
"""Frames between two estimates of a person's proportions."""
SETTLING_S = 2.0
"""Time over which a person's bones are estimated; poses are held back until then."""
_WINDOW_S = 0.3
"""Time over which the scale is taken; longer ones lag behind people who walk away."""
_FIRST_ROUNDS = 3
"""Number of searches of a person's first frame, whose scale is guessed from the bones."""
_SPREAD_FRAMES = 32
"""Proportions are estimated from this many frames or more, up to twice as many, once so many were seen."""

_OF_BONES = OneEuro(min_cutoff_hz=6.0, beta=2.0)
_OF_ROOT = OneEuro(min_cutoff_hz=0.8, beta=2.0)
_OF_BENDS = OneEuro(min_cutoff_hz=2.0, beta=1.0)
"""The 1-euro filters of bone rotations, of the root's path, and of the bends of spine, head and feet by the matches."""


class LiveOptions(Settings):
    """Settings of live reconstruction."""

    lag: int = Field(6, ge=0, le=1000, description="A live pose is written this many frames after its image")
    has_clean_up: bool = Field(True, description="Planted feet are stilled and the floor is kept")
    has_own_proportions: bool = Field(True, description="Bone lengths are estimated per person, else the reference's")
    metres_per_pixel: float | None = Field(
        None, gt=0, description="Scale of the image at the person where it is known; estimated otherwise"
    )
    min_noise_m: float = Field(MIN_NOISE_M, gt=0, description="The image is never believed better than this")


@dataclass(frozen=True)
class LivePose:
    """One person's pose in one frame, camera axes (x right, y up, z towards the camera), camera at the origin, metres.

    Args:
        person_id: Person, stable over frames.
        frame: Frame of the image.
        positions_m: op14 positions (14, 3).
        root_m: Mid-hip (3,).
        yaw_rad: Yaw of the matched projection.
        score_m: Mean distance of the seen joints from it.
        row: Matched row of the database.
        num_joints_seen: Number of joints seen in the image.
        body: The person's bones, the same in every frame.
        pelvis_m: Pelvis (3,), upright axes (y up), camera at the origin.
        body22_unitquat: Local rotations (22, 4) of the whole body from the standing T-pose, upright axes.
        floor_m: Height of the floor there; NaN without clean-up.
    """

    person_id: int
    frame: int
    positions_m: Array
    root_m: Array
    yaw_rad: float
    score_m: float
    row: int
    num_joints_seen: int
    body: BodyBones
    pelvis_m: Array
    body22_unitquat: Array
    floor_m: float


@dataclass(frozen=True)
class _Bones:
    """A person's bones: proportions over the reference (14,), the width of the hips in metres, and the size."""

    proportions: Array
    hip_width_m: float
    size: float = 1.0

    @property
    def lengths_m(self) -> Array:
        """Lengths (14,) of the bones that end in the joints of op14."""
        return REFERENCE_LENGTHS_M * self.proportions * self.size

    def as_tall_as(self, stature_m: float | None) -> _Bones:
        """Return these bones scaled to a stature, measured by the legs; unchanged if no stature is stated."""
        if stature_m is None:
            return self
        growth = stature_m / float(body_height_m(OP14, self.lengths_m))
        return replace(self, size=growth * self.size, hip_width_m=growth * self.hip_width_m)


_REFERENCE = _Bones(np.ones(OP14.num_joints), REFERENCE_HIP_WIDTH_M)


class LivePerson:
    """The reconstruction of one person as frames arrive: with reference bones until the person's own are known.

    Args:
        person_id: The person.
        searcher: Prepared database.
        rate_hz: Frames per second.
        lens: The lens, where known.
        options: Settings.
        floor: The floor shared with the other people of the video.
        stature_m: Stature, if known; otherwise about that of the reference body.
    """

    def __init__(
        self,
        person_id: int,
        searcher: Searcher,
        *,
        rate_hz: float,
        lens: Lens,
        options: LiveOptions | None = None,
        floor: LiveFloor | None = None,
        stature_m: float | None = None,
    ) -> None:
        self.person_id = person_id
        self.searcher, self.rate_hz, self.lens = searcher, rate_hz, lens
        self.options = options or LiveOptions()
        clean_up = LiveCleanUp(rate_hz, floor=floor, person=person_id)
        self.clean_up = clean_up if self.options.has_clean_up else None
        self._settling = max(1, round(SETTLING_S * rate_hz))
        self._held: list[tuple[int, Array, Array]] = []
        self._is_settled = not self.options.has_own_proportions
        self._stature_m = stature_m
        self._chain = _Chain(self, _REFERENCE.as_tall_as(stature_m), is_learning=not self._is_settled)

    def push(self, frame: int, keypoints_px: Array, confidence: Array) -> list[LivePose]:
        """Take this person's op14 keypoints (14, 2) of a frame; give the poses that are due."""
        poses = self._chain.push(frame, keypoints_px, confidence)
        if self._is_settled:
            return poses
        if self._chain.has_learned:
            self._held.append((frame, keypoints_px, confidence))
        return self._settle(frame)

    def advance(self, frame: int) -> list[LivePose]:
        """Return the poses that are due when the sequence is at `frame` and the person is not seen."""
        poses = self._chain.advance(frame)
        return poses if self._is_settled else self._settle(frame)

    def finish(self) -> list[LivePose]:
        """Return all poses that still wait."""
        poses = [] if self._is_settled or not self._held else self._settle(self._held[0][0] + self._settling)
        return [*poses, *self._chain.finish()] if self._is_settled else []

    def _settle(self, frame: int) -> list[LivePose]:
        """Return the delayed poses, computed again with the person's own bones, once these are known."""
        if not self._held or frame - self._held[0][0] < self._settling - 1:
            return []
        self._chain.finish()
        self._chain = _Chain(self, self._chain.learned().as_tall_as(self._stature_m), is_learning=False)
        held, self._held, self._is_settled = self._held, [], True
        return [*chain.from_iterable(starmap(self._chain.push, held)), *self._chain.advance(frame)]


class _Chain:
    """The steps from images to poses with given bones; the person's own bones are learned in parallel.

    A frame is placed by the scale so far, searched once, and placed again by its best match; then the yaws of its
    candidates are refined.  All of this is at the size of the reference, because scaling body and path about the camera
    leaves the image as it is.  While bones are learned, nothing is cleaned up: those poses are made again.
    """

    def __init__(self, person: LivePerson, bones: _Bones, *, is_learning: bool) -> None:
        self._person, self._options, self._searcher = person, person.options, person.searcher
        rate_hz = person.rate_hz
        self._viterbi = FixedLagViterbi(self._searcher.database, rate_hz=rate_hz, lag=self._options.lag)
        self._scales: deque[float] = deque(maxlen=max(3, round(_WINDOW_S * rate_hz)))
        self._waiting: deque[LiveFrame] = deque()
        self._fit = WindowFit(rate_hz, min_noise_m=self._options.min_noise_m)
        self._lengths_m, self._hip_width_m, self._size = bones.lengths_m, bones.hip_width_m, bones.size
        self._body = body_with_bones(self._lengths_m, self._hip_width_m)
        self._proportions = bones.proportions
        self._is_learning = is_learning
        self._spread: list[tuple[Array, Array, Array]] = []
        self._stride = 1
        self._num_seen = 0
        self._hip_widths: list[float] = []
        self._camera_rotmat: Array = self._searcher.database.camera.camera_from_upright_rotmat
        self._rotations, self._root, self._bends = (
            OneEuroFilter(settings, rate_hz) for settings in (_OF_BONES, _OF_ROOT, _OF_BENDS)
        )
        self._clean_up = None if is_learning else person.clean_up

    def push(self, frame: int, keypoints_px: Array, confidence: Array) -> list[LivePose]:
        """Take this person's op14 keypoints (14, 2) of a frame; give the poses that are due."""
        points = (keypoints_px - np.array(self._person.lens.principal_point_px)) * np.array([1.0, -1.0])
        weights = np.where(np.isfinite(points).all(axis=-1), np.nan_to_num(confidence), 0.0)
        seen = None
        if np.count_nonzero(weights > 0) >= MIN_JOINTS:
            with suppress(InputError):  # too little is seen to estimate the size; wait for a later frame
                seen = self._match(frame, points, weights)
        if seen is None:
            return self.advance(frame)
        self._waiting.append(seen)
        self._fit.see(seen, self._proportions)
        return self._poses(
            self._viterbi.push(np.array([frame]), seen.row[None], seen.yaw_steps[None], seen.match_m[None])
        )

    def advance(self, frame: int) -> list[LivePose]:
        """Return the poses that are due when the sequence is at `frame` and the person is not seen."""
        return self._poses(self._viterbi.decide_until(frame - self._options.lag))

    def finish(self) -> list[LivePose]:
        """Return all poses that still wait."""
        return self._poses(self._viterbi.decide_until(self._waiting[-1].frame)) if self._waiting else []

    def _match(self, frame: int, points: Array, weights: Array) -> LiveFrame | None:
        database, focal = self._searcher.database, self._person.lens.focal_px
        known = self._options.metres_per_pixel
        if known is not None:
            scale, rounds = known, 1
        elif self._scales:
            scale, rounds = median(self._scales), 1
        else:
            first = place_track(points[None], weights[None], self._searcher.reference, window=1)
            scale, rounds = float(first.metres_per_pixel[0]), _FIRST_ROUNDS
        rays, towards = straighten_rays(points[None], self._mid_hip(points, weights, scale)[None], focal)
        straight = rays[0]
        weights = np.where(np.isfinite(straight[:, 0]), weights, 0.0)
        centre = self._mid_hip(straight, weights, scale)
        ratio = float("nan")
        for _ in range(rounds):
            query = retarget_image((straight - centre) * scale, self._proportions)
            matches = self._searcher.index.search(query, weights, num_neighbours=NUM_CANDIDATES)
            if matches.projection[0] < 0:
                return None
            best = database.turned(matches.row[0], matches.yaw_index[0])
            matched = np.ascontiguousarray(database.camera.project(best))
            fit = match_scale(straight, weights, retarget_image(matched, 1.0 / self._proportions))
            ratio = float(fit[0])
            if np.isfinite(ratio):
                scale = known or median([*self._scales, ratio])
                centre = fit[1:3] - fit[3:] / scale
        if np.isfinite(ratio):
            self._scales.append(ratio)
        image_m = (straight - centre) * scale
        if self._is_learning:
            self._learn_proportions(image_m, weights, matched)
        refined, yaw_steps = refine_yaws(database, matches, retarget_image(image_m, self._proportions), weights)
        count = np.count_nonzero(refined.projection >= 0)
        row, yaw_steps = refined.row[:count], yaw_steps[:count]
        poses = database.turned(row, yaw_steps) @ self._camera_rotmat.T
        root = turn_with_camera(towards[0], np.array([*(centre * scale), -scale * focal]))
        return LiveFrame(frame, row, yaw_steps, refined.distance_m[:count], poses, root, image_m, weights)

    def _mid_hip(self, points: Array, weights: Array, scale: float) -> Array:
        """Return the middle of the hips (2,); if one is not seen, by mean joint positions, as in `place_track`."""
        if weights[_LEFT_HIP] > 0 and weights[_RIGHT_HIP] > 0:
            return mid_hip(points)
        reference = self._searcher.reference
        share = weights / reference.variance_m2
        off_mean = np.nan_to_num(points) - reference.mean_m / scale
        return np.asarray(share @ off_mean / share.sum())

    @property
    def has_learned(self) -> bool:
        """Whether any frame gave information on the bones."""
        return self._num_seen > 0

    def learned(self) -> _Bones:
        """Return the person's bones by all frames so far, once all poses of these frames were returned."""
        bones = _Bones(self._estimate_proportions(), REFERENCE_HIP_WIDTH_M)
        if not self._hip_widths:
            return bones
        mean_m = float(bones.lengths_m[[_LEFT_HIP, _RIGHT_HIP]].mean())
        return _Bones(bones.proportions, median(self._hip_widths) * mean_m)

    def _learn_proportions(self, own_m: Array, weights: Array, matched_m: Array) -> None:
        """Keep frames evenly spread over all seen so far, and estimate the proportions at intervals."""
        if self._num_seen % self._stride == 0:
            self._spread.append((own_m, weights, matched_m))
            if len(self._spread) == 2 * _SPREAD_FRAMES:
                self._spread, self._stride = self._spread[::2], 2 * self._stride
        self._num_seen += 1
        if self._num_seen % PROPORTIONS_EVERY == 0:
            self._proportions = self._estimate_proportions()

    def _estimate_proportions(self) -> Array:
        own_m, weights, matched_m = (np.stack(values) for values in zip(*self._spread, strict=True))
        return estimate_proportions(own_m, weights, matched_m)

    def _poses(self, ranks: list[int]) -> list[LivePose]:
        """Return the poses of frames whose candidates were just decided on."""
        path = self._viterbi.path
        return [self._pose(rank, path[at:]) for at, rank in enumerate(ranks)]

    def _pose(self, rank: int, path: Integers) -> LivePose:
        """Return the pose of the oldest frame; `path` has the ranks of the candidates of all waiting frames."""
        seen = self._waiting.popleft()
        unitquat = self._rotations.step(seen.frame, bone_rotations(self._fit.fit(path, self._proportions)))
        root = self._size * self._root.step(seen.frame, seen.root_m[None])[0]
        # Rotations of bones are relative to each other, so only the frame of the body is turned.
        turned = np.array(unitquat)
        turned[OP14.root] = multiply(camera_turns(-root[None])[0], unitquat[OP14.root])
        positions = place_bone_rotations(turned, self._lengths_m, root)
        if self._is_learning:
            hips = positions[[_LEFT_HIP, _RIGHT_HIP]]
            bones = np.linalg.norm(hips - positions[OP14.root], axis=-1)
            self._hip_widths.append(float(np.linalg.norm(hips[0] - hips[1]) / bones.mean()))
        upright = held_hips(positions[None], self._lengths_m, self._hip_width_m)[0] @ self._camera_rotmat
        floor = float("nan")
        if self._clean_up is not None:
            upright = self._clean_up.step(seen.frame, upright)
            floor = self._clean_up.floor_m - self._body.ankle_height_m
        pelvis, body22 = self._whole(seen.frame, seen.row[rank : rank + 1], upright, floor)
        positions = upright @ self._camera_rotmat.T
        return LivePose(
            person_id=self._person.person_id,
            frame=seen.frame,
            positions_m=positions,
            root_m=mid_hip(positions),
            yaw_rad=float(np.mod(seen.yaw_steps[rank] * self._searcher.database.yaw_step_rad, 2.0 * np.pi)),
            score_m=float(seen.match_m[rank]),
            row=int(seen.row[rank]),
            num_joints_seen=int(np.count_nonzero(seen.weights > 0)),
            body=self._body,
            pelvis_m=pelvis,
            body22_unitquat=body22,
            floor_m=floor,
        )

    def _whole(self, frame: int, row: Integers, upright_m: Array, floor_m: float) -> tuple[Array, Array]:
        """Return pelvis (3,) and local rotations (22, 4) of the whole body through a pose (14, 3), upright axes."""
        matched = bends_of(self._searcher.database, row)
        both = self._bends.step(frame, np.concatenate([matched.unitquat[0], matched.nose_unitquat]))
        bends = Bends(both[None, :-1], both[-1:])
        floor_m = floor_m if np.isfinite(floor_m) else -np.inf
        pelvis, body22 = pose_body(self._body, upright_m[None], bends, floor_m=floor_m)
        return pelvis[0], body22[0]
