"""The projection database: poses, the yaws at which they are seen, and the camera."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from pasdedeux.arrays import Array, Flags, Floats32, Integers
from pasdedeux.compiled import compiled
from pasdedeux.errors import InputError
from pasdedeux.skeletons import OP14


@dataclass(frozen=True)
class DatabaseCamera:
    """A camera on the +Z side of the body that looks at its mid-hip; rays are parallel; image x right, y up, metres.

    Images of a camera that looks elsewhere are turned first (`reconstruction.rays.straighten_rays`).

    Args:
        pitch_rad: Angle of the camera above the horizontal.
    """

    pitch_rad: float = 0.0

    @property
    def camera_from_upright_rotmat(self) -> Array:
        """Rotation (3, 3) from upright axes before the camera to the camera's own (x right, y up, z towards it).

        Before a camera that looks down, the top of the head comes nearer.
        """
        cosine, sine = np.cos(self.pitch_rad), np.sin(self.pitch_rad)
        return np.array([[1.0, 0.0, 0.0], [0.0, cosine, -sine], [0.0, sine, cosine]])

    def project(self, poses_m: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Project poses (*batch, joint, 3) about the mid-hip to (*batch, joint, 2) about its image."""
        x, up, towards = np.moveaxis(poses_m, -1, 0)
        if self.pitch_rad != 0.0:
            cosine, sine = np.cos(self.pitch_rad), np.sin(self.pitch_rad)
            up = cosine * up - sine * towards
        return np.stack([x, up], axis=-1)


@dataclass(frozen=True)
class Database:
    """Poses seen by a camera at every yaw step; projection number = row * num_yaws + yaw index.

    Poses are stored as float32: an error of 1e-7 of a metre-sized body, far below a pixel.

    Args:
        poses_m: Poses (row, 14, 3), reference proportions, mid-hip at the origin, facing +Z, metres; or people who
            are searched as one, 14 joints each (see `pairs`).
        is_sequence_start: Whether the row above has no previous frame of the same motion (row,).
        num_yaws: Yaw steps over the full turn (30 steps of 12 degrees in the paper).
        rate_hz: Frames per second of the motions in the database.
        camera: The camera.
        body22_unitquat: Local rotations (row, 22, 4) of the whole bodies from the standing T-pose, if known; the
            search ignores them.

    Raises:
        InputError: Shapes do not fit, no row, or a value is not finite.
    """

    poses_m: Floats32
    is_sequence_start: Flags
    num_yaws: int = 30
    rate_hz: float = 24.0
    camera: DatabaseCamera = field(default_factory=DatabaseCamera)
    body22_unitquat: Floats32 | None = None

    def __post_init__(self) -> None:
        """Check shapes and values; the first row always starts a motion."""
        poses = np.ascontiguousarray(self.poses_m, dtype=np.float32)
        starts = np.array(self.is_sequence_start, dtype=np.bool_)
        is_people = poses.ndim == 3 and poses.shape[1] % OP14.num_joints == 0 and poses.shape[2] == 3
        if not is_people or starts.shape != poses.shape[:1]:
            raise InputError(
                f"database poses have shape {poses.shape} and sequence starts {starts.shape}; "
                f"expected (rows, {OP14.num_joints}, 3) and (rows,)"
            )
        if len(poses) == 0:
            raise InputError("a projection database needs at least one pose")
        if not np.isfinite(poses).all():
            raise InputError(f"database row {int(np.argwhere(~np.isfinite(poses))[0][0])}: a value is not finite")
        starts[0] = True
        object.__setattr__(self, "poses_m", poses)
        object.__setattr__(self, "is_sequence_start", starts)

    @property
    def num_rows(self) -> int:
        """Number of poses."""
        return len(self.poses_m)

    @property
    def num_joints(self) -> int:
        """Joints of a pose."""
        return self.poses_m.shape[1]

    @property
    def num_projections(self) -> int:
        """Number of projections."""
        return self.num_rows * self.num_yaws

    @property
    def yaw_step_rad(self) -> float:
        """Angle between two yaw steps."""
        return 2.0 * np.pi / self.num_yaws

    def turned(self, rows: npt.ArrayLike, yaw_index: npt.ArrayLike) -> Array:
        """Return the poses (*batch, 14, 3) of these rows at these yaws, in camera axes for a level camera.

        Yaws count in steps and may lie between them.
        """
        row, yaw = np.asarray(rows, dtype=np.int64), np.asarray(yaw_index, dtype=np.float64) * self.yaw_step_rad
        if row.shape != yaw.shape:
            row, yaw = (np.ascontiguousarray(values) for values in np.broadcast_arrays(row, yaw))
        turned = _turned(self.poses_m, row.ravel(), yaw.ravel())
        return turned.reshape(*row.shape, *turned.shape[1:])

    def successors(self) -> Integers:
        """Return for each row the row of the next frame of its motion, or the row itself where there is none."""
        rows = np.arange(self.num_rows)
        has_next = np.zeros(self.num_rows, dtype=bool)
        has_next[:-1] = ~self.is_sequence_start[1:]
        return np.where(has_next, rows + 1, rows)

    def thinned(self, max_projections: int) -> Database:
        """Return a database of at most about so many projections, of evenly spaced poses; each starts a motion."""
        step = -(-self.num_projections // max_projections)
        if step <= 1:
            return self
        starts = np.ones(len(self.poses_m[::step]), dtype=bool)
        bodies = None if self.body22_unitquat is None else self.body22_unitquat[::step]
        return replace(self, poses_m=self.poses_m[::step], is_sequence_start=starts, body22_unitquat=bodies)

    def project(self, first_row: int = 0, last_row: int | None = None) -> Floats32:
        """Return the projections (row, yaw, 14, 2) of some rows, x right, y up, mid-hip at the origin, metres."""
        yaw = np.arange(self.num_yaws) * self.yaw_step_rad
        cosine, sine = (values.astype(np.float32)[:, None] for values in (np.cos(yaw), np.sin(yaw)))
        x, y, z = np.moveaxis(self.poses_m[first_row:last_row, None], -1, 0)
        turned = np.empty((len(x), self.num_yaws, self.num_joints, 3), dtype=np.float32)
        turned[..., 0] = cosine * x + sine * z
        turned[..., 1] = y
        turned[..., 2] = cosine * z - sine * x
        return np.asarray(self.camera.project(turned), dtype=np.float32)


@compiled()
def _turned(poses: Floats32, rows: Integers, yaw_rad: Array) -> Array:
    """Return poses of some rows (k, joint, 3), each turned by its yaw (k,)."""
    out = np.empty((rows.shape[0], poses.shape[1], 3))
    for at in range(rows.shape[0]):
        cosine, sine = np.cos(yaw_rad[at]), np.sin(yaw_rad[at])
        for joint in range(poses.shape[1]):
            x, z = np.float64(poses[rows[at], joint, 0]), np.float64(poses[rows[at], joint, 2])
            out[at, joint, 0] = cosine * x + sine * z
            out[at, joint, 1] = poses[rows[at], joint, 1]
            out[at, joint, 2] = cosine * z - sine * x
    return out
