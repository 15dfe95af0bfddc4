"""An index over draws: find the pairs that look most like an annotation, seen from the annotation's view.

The distance is that of the image under the view, after the best turn in the plane, over the seen joints.  Over fewer
joints it is never larger, so a few far-apart joints exclude nearly every draw; the rest is measured in full.  The
result is exact, except for ties.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array, Integers
from pasdedeux.cameras.frames import pair_frame
from pasdedeux.cameras.orthographic import view_rotmat
from pasdedeux.completion.kernels import LANES, rewrite_view_distances, write_view_distances
from pasdedeux.errors import InputError
from pasdedeux.kinematics.rotations import normalise
from pasdedeux.skeletons import PAIR17

MIN_SEEN = 4
"""Smallest number of seen joints of both people together for a comparison."""
_NUM_JOINTS = 2 * PAIR17.num_joints
_FAR_APART = ("left_wrist", "right_ankle", "head", "right_wrist", "left_ankle", "pelvis", "left_elbow")
_FIRST = [person * PAIR17.num_joints + PAIR17.index(name) for name in _FAR_APART for person in range(2)]
_ORDER = np.array(sorted(range(_NUM_JOINTS), key=lambda joint: (*_FIRST, joint).index(joint)), dtype=np.int64)
"""Joints of both people (34,) in the order of comparison: those that are farthest apart come first."""
_SLACK_M2 = 1e-4
"""Error bound of single precision in a sum of squares over 34 joints, with a wide margin."""
_BATCH = 32_768


@dataclass(frozen=True)
class NearestDraws:
    """Draws nearest to an image, nearest first.

    Args:
        draw: Index of each draw, (k,).
        view: Which of the views it was seen from, (k,).
        distance_m: Root mean square distance over the joints seen, after the best turn in the plane, (k,), metres.
    """

    draw: Integers
    view: Integers
    distance_m: Array


class DrawIndex:
    """Draws stored for retrieval by image, in single precision; 820 bytes per draw.

    Args:
        pairs_m: Draws (draw, person=2, joint=17, 3), metres, at least one, all finite.

    Raises:
        InputError: There is no draw, or a coordinate is not finite.
    """

    def __init__(self, pairs_m: npt.NDArray[np.floating]) -> None:
        if not len(pairs_m) or pairs_m.shape[1:] != (2, PAIR17.num_joints, 3):
            raise InputError(f"an index needs draws of shape (draw, 2, 17, 3), at least one; found {pairs_m.shape}")
        self.num_draws = len(pairs_m)
        num_blocks = -(-self.num_draws // LANES)
        self._points = np.zeros((num_blocks, _NUM_JOINTS, 3, LANES), dtype=np.float32)
        # A second copy, draw by draw, because draws measured in full are scattered.
        self._rows = np.empty((self.num_draws, _NUM_JOINTS, 3), dtype=np.float32)
        self._tilt = np.zeros((num_blocks, 2, LANES), dtype=np.float32)
        for start in range(0, self.num_draws, _BATCH):
            stop = min(start + _BATCH, self.num_draws)
            local, tilt = _own_frames(np.asarray(pairs_m[start:stop], dtype=np.float64))
            self._rows[start:stop] = local[:, _ORDER]
            block, lane = np.divmod(np.arange(start, stop), LANES)
            self._points[block, :, :, lane] = local[:, _ORDER]
            self._tilt[block, :, lane] = tilt
        if not np.isfinite(self._points).all():
            raise InputError("an index needs draws with finite coordinates")

    def nearest(self, image_m: Array, directions: Array, *, count: int = 1) -> NearestDraws:
        """Return the draws nearest to an image under any of several views; each draw appears once, under its best view.

        Args:
            image_m: Image points (person=2, joint=17, 2), metres, x right, y up; NaN where not seen.
            directions: Views in the pair's local frame, (view, 3).
            count: Number of draws, fewer if there are fewer.

        Raises:
            InputError: No view, or fewer than 4 joints seen.
        """
        joints, image = _seen(image_m)
        image = image - image.mean(axis=0)
        if not len(directions):
            raise InputError("retrieval needs at least one view of the annotation")
        count = min(count, self.num_draws)
        views = normalise(np.asarray(directions, dtype=np.float64))
        first = joints < len(_FIRST)
        few, near = (joints[first], image[first]) if first.sum() >= 3 else (joints, image)
        coarse = np.empty((len(views), len(self._points), LANES), dtype=np.float32)
        centred = (near - near.mean(axis=0)).astype(np.float32)
        for view, direction in enumerate(views):
            write_view_distances(self._points, self._tilt, direction.astype(np.float32), centred, few, coarse[view])
        flat = coarse.reshape(len(views), -1)[:, : self.num_draws]
        bound = flat.min(axis=0) if len(views) > 1 else flat[0]
        # The draws that are nearest by a few joints give an upper bound on the distances of the results.
        tried = np.argpartition(bound, min(4 * count, self.num_draws - 1))[: 4 * count]
        level = np.partition(self._measured(tried, views, image, joints).min(axis=1), count - 1)[count - 1] + _SLACK_M2
        left = np.flatnonzero(bound <= level)
        squared = self._measured(left, views, image, joints, ceiling_m2=level)
        best = squared.min(axis=1)
        order = np.lexsort((left, best))[:count]
        return NearestDraws(
            draw=left[order],
            view=np.argmin(squared[order], axis=1).astype(np.int64),
            distance_m=np.sqrt(best[order] / len(joints)),
        )

    def placed(self, draws: Integers, directions: Array, image_m: Array) -> Array:
        """Return draws in axes of the camera of the image, (n, person=2, joint=17, 3), metres.

        Args:
            draws: Indices of the draws, (n,).
            directions: View of each, (n, 3).
            image_m: Image points (person=2, joint=17, 2), metres; NaN where not seen.

        Returns:
            Camera axes: x right, y up, z towards the camera.  Over the seen joints, the draw is the best rigid fit to
            the image in the plane, and the mean depth is 0.
        """
        return self._seen_as(self._rows[draws].astype(np.float64), self._tilts(draws), directions, image_m)

    def placed_mean(self, direction: Array, image_m: Array) -> Array:
        """Return the mean of all draws in their local frames, in axes of the image's camera, (2, 17, 3), metres."""
        points, tilt = self._mean
        return np.asarray(self._seen_as(points[None], tilt[None], direction[None], image_m)[0])

    @cached_property
    def _mean(self) -> tuple[Array, Array]:
        return self._rows.mean(axis=0, dtype=np.float64), self._tilts(np.arange(self.num_draws)).mean(axis=0)

    def _tilts(self, draws: Integers) -> Array:
        return self._tilt[draws // LANES, :, draws % LANES].astype(np.float64)

    def _seen_as(self, points: Array, tilt: Array, directions: Array, image_m: Array) -> Array:
        joints, image = _seen(image_m)
        seen_from = view_rotmat(_towards(tilt, normalise(directions)), np.array([0.0, 1.0, 0.0]))
        points = np.einsum("nij,nkj->nki", seen_from, points)
        points = points - points[:, joints].mean(axis=1, keepdims=True)
        centre = image.mean(axis=0)
        image = image - centre
        a = np.sum(points[:, joints, :2] * image, axis=(1, 2))
        b = np.sum(points[:, joints, 0] * image[:, 1] - points[:, joints, 1] * image[:, 0], axis=1)
        angle = np.arctan2(b, a)[:, None]
        cosine, sine = np.cos(angle), np.sin(angle)
        out = np.empty(points.shape)
        out[:, _ORDER, 0] = cosine * points[..., 0] - sine * points[..., 1] + centre[0]
        out[:, _ORDER, 1] = sine * points[..., 0] + cosine * points[..., 1] + centre[1]
        out[:, _ORDER, 2] = points[..., 2]
        return out.reshape(len(points), 2, PAIR17.num_joints, 3)

    def _measured(
        self, draws: Integers, views: Array, image: Array, joints: Integers, *, ceiling_m2: float = np.inf
    ) -> Array:
        """Return squared distances (draw, view) in double precision; inf for draws known to be beyond a ceiling."""
        tilt = self._tilts(draws)
        squared = np.empty((len(draws), len(views)))
        for view, direction in enumerate(views):
            world = _towards(tilt, direction)
            errors = np.empty(len(draws))
            rewrite_view_distances(self._rows, world, draws, image, joints, ceiling_m2, errors)
            squared[:, view] = errors
        return squared


def _seen(image_m: Array) -> tuple[Integers, Array]:
    """Return the seen joints, by their place in the index, and their image points."""
    points = np.asarray(image_m, dtype=np.float64).reshape(_NUM_JOINTS, 2)[_ORDER]
    joints = np.flatnonzero(np.isfinite(points).all(axis=1))
    if len(joints) < MIN_SEEN:
        raise InputError(f"{len(joints)} joints of the two people are seen; retrieval needs at least {MIN_SEEN}")
    return joints, points[joints]


def _towards(tilt: Array, direction: Array) -> Array:
    """Return the unit directions (n, 3) of a view towards the camera, in the frames of draws with tilts (n, 2)."""
    a, b, c = np.moveaxis(np.asarray(direction, dtype=np.float64), -1, 0)
    sine, cosine = tilt[:, 0], tilt[:, 1]
    return normalise(np.stack([sine * a, cosine * a + b, sine * c], axis=-1))


def _own_frames(pairs_m: Array) -> tuple[Array, Array]:
    """Return pairs (n, 34, 3) in their local frames with j along y and i in the plane of x and y, and the tilt of i.

    The published frame is not square: i and j stand at an angle whose sine and cosine are the tilt (n, 2).
    """
    axes = pair_frame(pairs_m).axes
    i, j = axes[..., 0], axes[..., 1]
    cosine = np.sum(i * j, axis=-1, keepdims=True)
    across = normalise(i - cosine * j)
    square = np.stack([across, j, np.cross(across, j)], axis=-1)
    points = pairs_m.reshape(len(pairs_m), _NUM_JOINTS, 3)
    points = points - points.mean(axis=1, keepdims=True)
    sine = np.sqrt(np.maximum(1.0 - cosine**2, 0.0))
    return np.einsum("nji,nik->njk", points, square), np.concatenate([sine, cosine], axis=1)
