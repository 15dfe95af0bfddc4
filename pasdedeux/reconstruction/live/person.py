"""One person's reconstruction as frames arrive: matched, chosen with a fixed lag, fitted, filtered, cleaned up.

Scale and place come from the frames of the last moments; every frame is searched once, its yaws are refined between the
steps, Viterbi chooses among the candidates, the pose is fitted to a few frames of the image, a 1-euro filter goes over
rotations and root, and planted feet are stilled. Bones are learned from a person's first moments, whose poses are held
back and made again with them: no bone ever changes.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from functools import partial
from itertools import chain, starmap
from statistics import median

import numpy as np
import numpy.typing as npt
from pydantic import Field

from pasdedeux.arrays import Array
from pasdedeux.errors import InputError
from pasdedeux.kinematics.rotations import multiply, rotate
from pasdedeux.people.identity import IdentityOptions
from pasdedeux.projections.retarget import REFERENCE_LENGTHS_M, mid_hip
from pasdedeux.projections.scale import match_scale, place_track
from pasdedeux.reconstruction.body import REFERENCE_HIP_WIDTH_M, Bends, Body, bends_of, body_of, pose_body
from pasdedeux.reconstruction.body_kernels import held_hips
from pasdedeux.reconstruction.bones import bone_rotations, place_bone_rotations
from pasdedeux.reconstruction.live.cleanup import LiveCleanUp, LiveCleanUpOptions, LiveFloor
from pasdedeux.reconstruction.live.window_fit import WindowFit, WindowFitOptions
from pasdedeux.reconstruction.proportions import estimate_proportions, retarget_image
from pasdedeux.reconstruction.rays import camera_turns, straighten_rays
from pasdedeux.reconstruction.reconstruct import Searcher
from pasdedeux.reconstruction.smoothing import OneEuro, OneEuroFilter
from pasdedeux.reconstruction.temporal import Decision, FixedLagViterbi, TemporalWeights
from pasdedeux.reconstruction.tracks import Lens
from pasdedeux.reconstruction.yaw import refine_yaws
from pasdedeux.settings import Settings
from pasdedeux.skeletons import OP14

Integers = npt.NDArray[np.int64]

_LEFT_HIP, _RIGHT_HIP = OP14.index("left_hip"), OP14.index("right_hip")

_FIRST_ROUNDS = 3
"""Searches of a person's first frame, whose scale is only guessed from the bones."""

_SPREAD_FRAMES = 32
"""Frames that proportions are estimated from, at least when as many were seen, and less than twice as many."""


class LiveOptions(Settings):
    """How people are reconstructed live."""

    lag: int = Field(6, ge=0, description="A pose leaves this many frames after its image")
    num_candidates: int = Field(20, ge=1, description="Projections kept per frame")
    min_joints: int = Field(4, ge=1, description="Frames with fewer joints of a person give no pose")
    window_s: float = Field(
        0.3, gt=0, description="Scale is that of the last so many seconds; longer ones lag behind people who walk away"
    )
    proportions_every: int = Field(15, ge=1, description="Frames between two estimates of a person's proportions")
    temporal: TemporalWeights = Field(TemporalWeights(), description="Costs of the choice over time")
    smoothing: OneEuro = Field(OneEuro(min_cutoff_hz=6.0, beta=2.0), description="The 1-euro filter of rotations")
    root_smoothing: OneEuro = Field(
        OneEuro(min_cutoff_hz=0.8, beta=2.0), description="That of the root's path, whose growth is in Hz per m/s"
    )
    bend_smoothing: OneEuro = Field(
        OneEuro(min_cutoff_hz=2.0, beta=1.0), description="That of what spine, head and feet take from the matches"
    )
    identities: IdentityOptions = Field(IdentityOptions(), description="How people are followed")
    metres_per_pixel: float | None = Field(
        None, gt=0, description="Scale of the image at the person where it is known; estimated otherwise"
    )
    has_own_proportions: bool = Field(True, description="Bone lengths are estimated per person, else the reference's")
    settling_s: float = Field(
        2.0,
        gt=0,
        description="A person's bones are estimated for this time and kept; poses until then are held back so long",
    )
    is_fitted: bool = Field(True, description="Poses are fitted to the images of their window")
    fit: WindowFitOptions = Field(WindowFitOptions(), description="What the fit believes")
    has_clean_up: bool = Field(True, description="Planted feet are stilled and the floor is kept")
    clean_up: LiveCleanUpOptions = Field(LiveCleanUpOptions(), description="How")


@dataclass(frozen=True)
class LivePose:
    """One person's pose in one frame, camera axes (x right, y up, z towards the camera), camera at the origin, metres.

    Args:
        person_id: Person, stable over frames.
        frame: Frame of the image.
        positions_m: op14 positions (14, 3).
        bone_unitquat: Rotations of the bones (14, 4), see `bones.bone_rotations`.
        root_m: Mid-hip (3,).
        yaw_rad: Yaw of the matched projection.
        score_m: Mean distance per seen joint to it.
        row: Database row matched.
        num_joints_seen: Joints seen in the image.
        body: The person's bones, the same in every frame.
        pelvis_m: Pelvis (3,), upright axes (y up), camera at the origin.
        body22_unitquat: Local rotations (22, 4) of the whole body from the standing T-pose, upright axes.
        floor_m: Height of the floor there; NaN where it is not kept.
    """

    person_id: int
    frame: int
    positions_m: Array
    bone_unitquat: Array
    root_m: Array
    yaw_rad: float
    score_m: float
    row: int
    num_joints_seen: int
    body: Body
    pelvis_m: Array
    body22_unitquat: Array
    floor_m: float


@dataclass(frozen=True)
class _Waiting:
    """A frame that waits for its decision."""

    frame: int
    row: Integers
    yaw_steps: Array
    distance_m: Array
    pose_m: Array
    root_m: Array
    own_m: Array
    weights: Array


@dataclass(frozen=True)
class _ProportionFrame:
    """A frame that proportions are taken from: own and matched images, metres."""

    weights: Array
    own_m: Array
    matched_m: Array


@dataclass(frozen=True)
class _Bones:
    """A person's bones: shares of the reference's (14,), and the width of the hips, metres."""

    proportions: Array
    hip_width_m: float

    @property
    def lengths_m(self) -> Array:
        """Lengths (14,) of the bones that end in the joints of op14."""
        return REFERENCE_LENGTHS_M * self.proportions


_REFERENCE = _Bones(np.ones(OP14.num_joints), REFERENCE_HIP_WIDTH_M)


class LivePerson:
    """One person's reconstruction as frames arrive.

    Args:
        person_id: Who.
        searcher: Database made ready.
        rate_hz: Frames per second.
        lens: The camera as far as it is known.
        options: How.
        floor: The floor shared with the other people of the video.
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
    ) -> None:
        self.person_id = person_id
        options = options or LiveOptions()
        self._start = partial(_Chain, person_id, searcher, rate_hz, lens, options)
        clean_up = LiveCleanUp(rate_hz, options.clean_up, floor=floor, person=person_id)
        self._clean_up = clean_up if options.has_clean_up else None
        self._settling = max(1, round(options.settling_s * rate_hz))
        self._held: list[tuple[int, Array, Array]] = []
        self._is_settled = not options.has_own_proportions
        self._chain = self._start(_REFERENCE, self._clean_up if self._is_settled else None)

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
        """Return the poses held back, made with the person's own bones, as soon as these are known."""
        if not self._held or frame - self._held[0][0] < self._settling - 1:
            return []
        self._chain.finish()
        self._chain = self._start(self._chain.learned(), self._clean_up)
        held, self._held, self._is_settled = self._held, [], True
        return [*chain.from_iterable(starmap(self._chain.push, held)), *self._chain.advance(frame)]


class _Chain:
    """The steps from images to poses with given bones; what the images say of the bones is learned beside them.

    A frame is placed by the scale so far, searched once, placed anew by its best match, and its candidates are turned
    to their best yaws at that place.
    """

    def __init__(
        self,
        person_id: int,
        searcher: Searcher,
        rate_hz: float,
        lens: Lens,
        options: LiveOptions,
        bones: _Bones,
        clean_up: LiveCleanUp | None,
    ) -> None:
        self._person_id = person_id
        self._options = options
        self._searcher = searcher
        self._lens = lens
        self._viterbi = FixedLagViterbi(searcher.database, rate_hz=rate_hz, lag=options.lag, weights=options.temporal)
        self._scales: deque[float] = deque(maxlen=max(3, round(options.window_s * rate_hz)))
        self._waiting: deque[_Waiting] = deque()
        self._fit = WindowFit(rate_hz, options.fit)
        self._lengths_m, self._hip_width_m = bones.lengths_m, bones.hip_width_m
        self._body = body_of(self._lengths_m, self._hip_width_m)
        self._proportions = bones.proportions
        self._is_learning = options.has_own_proportions and bones is _REFERENCE
        self._spread: list[_ProportionFrame] = []
        self._stride = 1
        self._num_seen = 0
        self._hip_widths: list[float] = []
        self._bends = OneEuroFilter(options.bend_smoothing, rate_hz)
        self._camera_rotmat: Array = np.asarray(searcher.database.camera.camera_from_upright_rotmat)
        self._rotations = OneEuroFilter(options.smoothing, rate_hz)
        self._clean_up = clean_up
        self._root = OneEuroFilter(options.root_smoothing, rate_hz)

    def push(self, frame: int, keypoints_px: Array, confidence: Array) -> list[LivePose]:
        """Take this person's op14 keypoints (14, 2) of a frame; give the poses that are due."""
        points = (keypoints_px - np.array(self._lens.principal_point_px)) * np.array([1.0, -1.0])
        weights = np.where(np.isfinite(points).all(axis=-1), np.nan_to_num(confidence), 0.0)
        if np.count_nonzero(weights > 0) >= self._options.min_joints:
            try:
                waiting = self._match(frame, points, weights)
            except InputError:
                waiting = None  # too little of the person to tell the size by; a later frame will do
            if waiting is not None:
                self._waiting.append(waiting)
                if self._options.is_fitted:
                    distance = float(np.linalg.norm(waiting.root_m))
                    self._fit.see(
                        frame,
                        waiting.own_m,
                        waiting.weights,
                        waiting.pose_m,
                        waiting.distance_m,
                        distance,
                        self._proportions,
                    )
                return self._poses(
                    self._viterbi.push(
                        np.array([frame]), waiting.row[None], waiting.yaw_steps[None], waiting.distance_m[None]
                    )
                )
        return self.advance(frame)

    def advance(self, frame: int) -> list[LivePose]:
        """Return the poses that are due when the sequence is at `frame` and the person is not seen."""
        return self._poses(self._viterbi.decide_until(frame - self._options.lag))

    def finish(self) -> list[LivePose]:
        """Return all poses that still wait."""
        if not self._waiting:
            return []
        return self._poses(self._viterbi.decide_until(self._waiting[-1].frame))

    def _match(self, frame: int, points: Array, weights: Array) -> _Waiting | None:
        database, focal = self._searcher.database, self._lens.focal_px
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
            found = self._searcher.index.search(query, weights, num_neighbours=self._options.num_candidates)
            if found.projection[0] < 0:
                return None
            best = database.turned(found.row[0], found.yaw_index[0])
            matched = np.ascontiguousarray(database.camera.project(best))
            fit = match_scale(straight, weights, retarget_image(matched, 1.0 / self._proportions))
            ratio = float(fit[0])
            if np.isfinite(ratio):
                scale = known or median([*self._scales, ratio])
                centre = fit[1:3] - fit[3:] / scale
        if np.isfinite(ratio):
            self._scales.append(ratio)
        own = (straight - centre) * scale
        if self._is_learning:
            self._learn_proportions(_ProportionFrame(weights, own, matched))
        refined = refine_yaws(database, found, retarget_image(own, self._proportions), weights)
        order = np.argsort(refined.distance_m, kind="stable")[: np.count_nonzero(found.projection >= 0)]
        row, yaw_steps = found.row[order], refined.yaw_steps[order]
        poses = database.turned(row, yaw_steps) @ self._camera_rotmat.T
        place = np.append(centre * scale, -scale * focal)
        return _Waiting(
            frame,
            row,
            yaw_steps,
            refined.distance_m[order],
            poses,
            rotate(camera_turns(towards)[0], place),
            own,
            weights,
        )

    def _mid_hip(self, points: Array, weights: Array, scale: float) -> Array:
        """Return the middle of the hips, or where joints are on average says that it is (2,), as `place_track` does."""
        if weights[_LEFT_HIP] > 0 and weights[_RIGHT_HIP] > 0:
            return mid_hip(points)
        reference = self._searcher.reference
        share = weights / reference.variance_m2
        off_mean = np.nan_to_num(points) - reference.mean_m / scale
        return np.asarray(share @ off_mean / share.sum())

    @property
    def has_learned(self) -> bool:
        """Whether a frame said something of the bones."""
        return self._num_seen > 0

    def learned(self) -> _Bones:
        """Return the person's own bones as the frames so far say, once all their poses were given."""
        proportions = self._estimate_proportions()
        width = REFERENCE_HIP_WIDTH_M
        if self._hip_widths:
            bones_m = REFERENCE_LENGTHS_M * proportions
            width = median(self._hip_widths) * float(bones_m[[_LEFT_HIP, _RIGHT_HIP]].mean())
        return _Bones(proportions, width)

    def _learn_proportions(self, seen: _ProportionFrame) -> None:
        """Keep a frame of those spread over all that were seen, and estimate the proportions now and then."""
        if self._num_seen % self._stride == 0:
            self._spread.append(seen)
            if len(self._spread) == 2 * _SPREAD_FRAMES:
                self._spread, self._stride = self._spread[::2], 2 * self._stride
        self._num_seen += 1
        if self._num_seen % self._options.proportions_every == 0:
            self._proportions = self._estimate_proportions()

    def _estimate_proportions(self) -> Array:
        return estimate_proportions(
            np.stack([one.own_m for one in self._spread]),
            np.stack([one.weights for one in self._spread]),
            np.stack([one.matched_m for one in self._spread]),
        )

    def _poses(self, decided: list[Decision]) -> list[LivePose]:
        """Return the poses of frames that were just decided on."""
        path = self._viterbi.path
        return [self._pose(one, path[at:]) for at, one in enumerate(decided)]

    def _pose(self, decision: Decision, path: Integers) -> LivePose:
        """Return the pose of the oldest frame; `path` has the candidates that it and all waiting frames follow."""
        waiting = self._waiting.popleft()
        assert waiting.frame == decision.frame, "every frame pushed is decided once, in order"
        rank = decision.rank
        pose = self._fit.fit(path, self._proportions) if self._options.is_fitted else waiting.pose_m[rank]
        unitquat = self._rotations.step(waiting.frame, bone_rotations(pose))
        root = self._root.step(waiting.frame, waiting.root_m[None])[0]
        # Bones turn against each other, so only the body's frame turns with the whole.
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
            upright = self._clean_up.step(waiting.frame, upright)
            floor = self._clean_up.floor_m - self._body.ankle_height_m
        pelvis, body22 = self._whole(decision, waiting, upright, floor)
        positions = upright @ self._camera_rotmat.T
        turned, root = bone_rotations(positions), mid_hip(positions)
        return LivePose(
            person_id=self._person_id,
            frame=waiting.frame,
            positions_m=positions,
            bone_unitquat=turned,
            root_m=root,
            yaw_rad=float(np.mod(waiting.yaw_steps[rank] * self._searcher.database.yaw_step_rad, 2.0 * np.pi)),
            score_m=float(waiting.distance_m[rank]),
            row=int(waiting.row[rank]),
            num_joints_seen=int(np.count_nonzero(waiting.weights > 0)),
            body=self._body,
            pelvis_m=pelvis,
            body22_unitquat=body22,
            floor_m=floor,
        )

    def _whole(self, decision: Decision, waiting: _Waiting, upright_m: Array, floor_m: float) -> tuple[Array, Array]:
        """Return pelvis (3,) and local rotations (22, 4) of the whole body through a pose (14, 3), upright axes."""
        said = bends_of(self._searcher.database, waiting.row[decision.rank : decision.rank + 1])
        both = self._bends.step(waiting.frame, np.concatenate([said.unitquat[0], said.nose_unitquat]))
        pelvis, body22 = pose_body(
            self._body,
            upright_m[None],
            Bends(both[None, :-1], both[-1:]),
            floor_m=floor_m if np.isfinite(floor_m) else -np.inf,
        )
        return pelvis[0], body22[0]
