"""The pinhole camera, without lens distortion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pasdedeux.arrays import Array, Flags
from pasdedeux.errors import InputError, check_positive


@dataclass(frozen=True)
class Projection:
    """Points seen by a camera: pixels (*batch, 2), x right and y down, and depths (*batch,) in metres.

    The depth is measured along the optical axis, positive in front of the camera; the pixels of a point that is not in
    front of the camera, or not finite, are NaN.
    """

    px: Array
    depth_m: Array


@dataclass(frozen=True)
class PinholeCamera:
    """A pinhole camera; its own axes are x right, y up, z towards the camera, so it looks along -z.

    Args:
        focal_px: Focal length in pixels.
        principal_point_px: Pixel on the optical axis, (2,), x right and y down.
        camera_from_world_rotmat: Rotation from world to camera axes, (3, 3).
        position_m: World position of the camera, (3,), metres.
        image_size_px: Width and height of the image, for `is_inside`; points outside are projected, too.

    Raises:
        InputError: The focal length is not positive, a shape is wrong, a value is not finite, the matrix is not a
            proper rotation (a reflection is refused: it would mirror people), or the image is empty.
    """

    focal_px: float
    principal_point_px: Array
    camera_from_world_rotmat: Array
    position_m: Array
    image_size_px: tuple[int, int] = (1920, 1080)

    def __post_init__(self) -> None:
        """Check every field."""
        check_positive(self.focal_px, "camera: the focal length in pixels")
        for name, shape in (("principal_point_px", (2,)), ("position_m", (3,)), ("camera_from_world_rotmat", (3, 3))):
            value = np.asarray(getattr(self, name), dtype=np.float64)
            if value.shape != shape or not np.isfinite(value).all():
                raise InputError(f"camera: {name} must hold finite numbers of shape {shape}, found {value.tolist()}")
            object.__setattr__(self, name, value)
        rotmat = self.camera_from_world_rotmat
        # 1e-5 lets a rotation stored in float32 pass.
        if np.abs(rotmat @ rotmat.T - np.eye(3)).max() > 1e-5 or np.linalg.det(rotmat) < 0:
            raise InputError("camera: camera_from_world_rotmat is not a proper rotation")
        if min(self.image_size_px) < 1:
            raise InputError(f"camera: the image is {self.image_size_px} px, both sides must be at least 1")

    @property
    def pitch_rad(self) -> float:
        """Angle by which the camera looks down, in a world whose y is up, whatever its roll."""
        return float(np.arcsin(np.clip(self.camera_from_world_rotmat[2, 1], -1.0, 1.0)))

    def camera_from_world(self, points: Array) -> Array:
        """Return world points (*batch, 3) in camera axes, metres; z is negative in front of the camera."""
        return np.asarray((points - self.position_m) @ self.camera_from_world_rotmat.T)

    def project(self, points: Array) -> Projection:
        """Project world points (*batch, 3), metres; a NaN point stays NaN."""
        seen = self.camera_from_world(np.asarray(points, dtype=np.float64))
        depth = -seen[..., 2]
        is_in_front = depth > 1e-9
        scale = self.focal_px / np.where(is_in_front, depth, np.nan)
        x = self.principal_point_px[0] + scale * seen[..., 0]
        y = self.principal_point_px[1] - scale * seen[..., 1]
        return Projection(px=np.stack([x, y], axis=-1), depth_m=depth)

    @classmethod
    def locate(
        cls,
        points_m: Array,
        px: Array,
        *,
        focal_px: float,
        principal_point_px: Array,
        camera_from_world_rotmat: Array,
        image_size_px: tuple[int, int],
    ) -> PinholeCamera:
        """Return the camera of this lens and orientation that sees world points (n, 3), metres, at pixels (n, 2).

        Its place is by least squares: in camera axes every point, displaced by t, lies on its ray (u, v, -1), so that
        x + t_x + u (z + t_z) = 0, and so with y, which is linear in t.  Two points determine it; points with NaN are
        ignored.

        Raises:
            InputError: The points do not determine it.
        """
        is_known = np.isfinite(points_m).all(axis=-1) & np.isfinite(px).all(axis=-1)
        turned_m = np.asarray(points_m, dtype=np.float64)[is_known] @ camera_from_world_rotmat.T
        ray = (px[is_known] - principal_point_px) * [1.0, -1.0] / focal_px  # at z = -1
        zero, ones = np.zeros(len(turned_m)), np.ones(len(turned_m))
        rows = [np.stack([ones, zero, ray[:, 0]], axis=-1), np.stack([zero, ones, ray[:, 1]], axis=-1)]
        known = -(turned_m[:, :2] + ray * turned_m[:, 2:])
        displacement, _, rank, _ = np.linalg.lstsq(np.concatenate(rows), known.T.reshape(-1), rcond=None)
        if rank < 3:
            raise InputError(f"a camera is located by two points or more that it sees apart; {len(turned_m)} are known")
        position = -displacement @ camera_from_world_rotmat
        return cls(focal_px, principal_point_px, camera_from_world_rotmat, position, image_size_px)

    def is_inside(self, px: Array) -> Flags:
        """Tell which pixels (*batch, 2) lie inside the image; NaN does not."""
        width, height = self.image_size_px
        return np.asarray((px >= 0).all(axis=-1) & (px[..., 0] < width) & (px[..., 1] < height))
