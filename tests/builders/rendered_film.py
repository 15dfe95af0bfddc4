"""Films whose 2D and 3D is known: people as shaded, textured capsules before a cluttered, moving background."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from pasdedeux.cameras.pinhole import PinholeCamera
from pasdedeux.cameras.virtual_video import look_at_camera
from pasdedeux.choreography.duets import make_duet
from pasdedeux.formats.poses2d.annotated_frames import AnnotatedFrames
from pasdedeux.formats.rigs.working_poses import derive_working_poses
from pasdedeux.kinematics import Motion
from pasdedeux.kinematics.rotations import rotmat_from_unitquat, unitquat_from_rotvec
from pasdedeux.plausibility.capsules import RADIUS_PER_HEIGHT
from pasdedeux.skeletons import BODY22
from pasdedeux.skeletons.layouts import LAYOUTS
from tests.builders.crowds import salsa_motions

Array = npt.NDArray[np.float64]
Image = npt.NDArray[np.uint8]

_RADII_M = 1.1 * 1.7 * np.array([RADIUS_PER_HEIGHT.get(name, 0.0) for name in BODY22.joint_names])
_RADII_M[BODY22.index("head")] *= 1.5
_LIGHT = np.array([0.4, 0.7, 0.6]) / np.linalg.norm([0.4, 0.7, 0.6])
_COLOURS = ((200, 120, 70), (70, 90, 210), (60, 170, 90))
"""Shirts, BGR; trousers are darker."""


@dataclass(frozen=True)
class Bodies:
    """Motion of people: (frame, person, 22, 3), (frame, person, 22, 4) and (frame, person, 17, 3), metres."""

    body22_m: Array
    unitquat: Array
    pair17_m: Array


def duet_bodies(name: str, *, seconds: float, rate_hz: float = 30.0, frames: slice = slice(None)) -> Bodies:
    """Return a built-in duet, or some of its frames."""
    return _bodies(make_duet(name, duration_s=seconds, rate_hz=rate_hz).motions, "body22", frames)


def salsa_bodies(data_dir: Path, take: str, frames: slice = slice(None), *, rate_hz: float = 30.0) -> Bodies:
    """Return a piece of a salsa take."""
    motions = [motion.resample(rate_hz) for motion in salsa_motions(data_dir, take)]
    return _bodies(motions, "cmu_daz", frames)


def _bodies(motions: Iterable[Motion], layout: str, frames: slice) -> Bodies:
    poses = [derive_working_poses(motion, LAYOUTS[layout]) for motion in motions]
    count = min(len(pose.pair17_m) for pose in poses)
    return Bodies(
        np.stack([pose.body22_m[:count] for pose in poses], axis=1)[frames],
        np.stack([pose.body22_world_unitquat[:count] for pose in poses], axis=1)[frames],
        np.stack([pose.pair17_m[:count] for pose in poses], axis=1)[frames],
    )


@dataclass(frozen=True)
class Film:
    """A film and what is true of it.

    Args:
        images: (frame, height, width, 3) BGR.
        px: True pair17 joints (frame, person, 17, 2).
        is_visible: Joints that nothing is in front of (frame, person, 17).
        cameras: A camera for each frame.
    """

    images: list[Image]
    px: Array
    is_visible: npt.NDArray[np.bool_]
    cameras: list[PinholeCamera]

    @property
    def height_px(self) -> float:
        """Mean height of the people's boxes."""
        return float((self.px[..., 1].max(axis=-1) - self.px[..., 1].min(axis=-1)).mean())


def render(
    bodies: Bodies,
    *,
    size: tuple[int, int] = (640, 480),
    yaw_rad: float = 0.5,
    turn_rad: float = 0.15,
    moves: Array | None = None,
    noise: float = 3.0,
    blur: int = 2,
    seed: int = 0,
) -> Film:
    """Film people through a camera that turns round them; each image is the mean of `blur` moments of the exposure.

    `moves` (frame, 4) are pan, tilt and roll of the camera at its place, radians, and its zoom.
    """
    rng = np.random.default_rng(seed)
    num_frames, people = bodies.body22_m.shape[:2]
    width, height = size
    background = _clutter(rng, (3 * width, 2 * height))
    textures = [[_texture(rng, person, child) for _, child in BODY22.bones] for person in range(people)]
    target = bodies.body22_m[..., 0, :].mean(axis=(0, 1))
    axes = _rest_axes(bodies)
    cameras, images, visible = [], [], []
    reach = np.linalg.norm((bodies.body22_m - target)[..., [0, 2]], axis=-1).max()
    distance = 3.0 + reach
    for frame in range(num_frames):
        turn = yaw_rad + turn_rad * np.sin(2.0 * frame / 30.0)
        camera = look_at_camera(
            target,
            distance_m=distance,
            yaw_rad=turn,
            pitch_rad=0.12,
            focal_px=0.62 * height * distance / 1.7,
            image_size_px=size,
        )
        camera, steady = camera if moves is None else moved(camera, *moves[frame]), camera
        cameras.append(camera)
        mean = np.zeros((height, width, 3), np.float32)
        depth = np.zeros((height, width), np.float32)
        for moment in range(blur):
            share = 0.5 * moment / blur
            after = min(frame + 1, num_frames - 1)
            joints = (1 - share) * bodies.body22_m[frame] + share * bodies.body22_m[after]
            shift = np.array([width + (turn - yaw_rad) * camera.focal_px * 0.8, 0.5 * height])
            if moves is None:
                image = cv2.getRectSubPix(background, size, tuple(np.float32(shift + np.array(size) / 2.0)))
            else:
                image = cv2.warpPerspective(background, _image_from_wall(camera, steady, shift), size)
            image = image.astype(np.float32)
            drawn = np.full((height, width), np.inf, np.float32)
            for person in range(people):
                rotmat = rotmat_from_unitquat(bodies.unitquat[frame, person])
                for bone, (parent, child) in enumerate(BODY22.bones):
                    ends = camera.camera_from_world(joints[person, [parent, child]])
                    to_rest = (camera.camera_from_world_rotmat @ rotmat[parent] @ axes[person, bone]).T
                    _draw(image, drawn, camera, ends, _RADII_M[child], to_rest, textures[person][bone])
            mean += image / blur
            depth = drawn if moment == 0 else depth
        image = mean + rng.normal(0.0, noise, mean.shape).astype(np.float32)
        images.append(np.clip(image, 0, 255).astype(np.uint8))
        seen = camera.project(bodies.pair17_m[frame])
        x, y = (np.clip(seen.px[..., i].round().astype(int), 0, size[i] - 1) for i in (0, 1))
        visible.append(camera.is_inside(seen.px) & (depth[y, x] > seen.depth_m - 0.16))
    px = np.stack([camera.project(pair).px for camera, pair in zip(cameras, bodies.pair17_m, strict=True)])
    return Film(images, px, np.stack(visible), cameras)


def hand_held(num_frames: int, *, shake_px: float = 0.0, pan_rad: float = 0.0, zoom: float = 1.0) -> Array:
    """Return moves of a camera (frame, 4): shaken by some pixels of 640, panned by an angle, and zoomed, over time."""
    time = np.linspace(0.0, 1.0, num_frames)
    rng, beats = np.random.default_rng(1), np.arange(num_frames) / 30.0
    waves = [sum(np.sin(2 * np.pi * hz * beats + rng.uniform(0, 7)) for hz in (0.7, 1.6, 3.1)) for _ in range(3)]
    pan, tilt, roll = np.array(waves) * shake_px / 3.0 * [[1 / 600], [1 / 600], [1 / 900]]
    return np.stack([pan + pan_rad * (time - 0.5), tilt, roll, zoom ** (time - 0.5)], axis=-1)


def moved(camera: PinholeCamera, pan: float, tilt: float, roll: float, zoom: float) -> PinholeCamera:
    """Return a camera that has turned by these angles, radians, and zoomed."""
    turned = rotmat_from_unitquat(unitquat_from_rotvec(np.array([[0.0, pan, 0.0], [tilt, 0.0, 0.0], [0.0, 0.0, roll]])))
    rotmat = turned[2] @ turned[1] @ turned[0] @ camera.camera_from_world_rotmat
    return replace(camera, camera_from_world_rotmat=rotmat, focal_px=zoom * camera.focal_px)


def _image_from_wall(camera: PinholeCamera, steady: PinholeCamera, shift: Array) -> Array:
    """Return the homography from the wall, which is far away, to the image of a camera that has turned."""
    flip = np.diag([1.0, -1.0, -1.0])  # camera axes to x right, y down, z away
    lenses = []
    for lens in (camera, steady):
        cx, cy = lens.principal_point_px
        lenses.append(np.array([[lens.focal_px, 0.0, cx], [0.0, lens.focal_px, cy], [0.0, 0.0, 1.0]]))
    turn = flip @ camera.camera_from_world_rotmat @ steady.camera_from_world_rotmat.T @ flip
    at = np.array([[1.0, 0.0, -shift[0]], [0.0, 1.0, -shift[1]], [0.0, 0.0, 1.0]])
    return np.asarray(lenses[0] @ turn @ np.linalg.inv(lenses[1]) @ at)


def write_film(path: Path, images: Iterable[Image], *, rate_hz: float = 30.0) -> Path:
    """Write images as a film: MJPG in AVI, VP9 in WebM, MPEG-4 in MP4."""
    writer = None
    for image in images:
        if writer is None:
            code = cv2.VideoWriter.fourcc(*{".avi": "MJPG", ".webm": "VP90"}.get(path.suffix, "mp4v"))
            writer = cv2.VideoWriter(str(path), code, rate_hz, image.shape[1::-1])
        writer.write(image)
    assert writer is not None
    writer.release()
    return path


def keys_of(film: Film, every: int = 15, *, noise_px: float = 0.0) -> Iterator[tuple[int, int, int, Array]]:
    """Yield frame, person, joint and place of visible joints in every so many frames, and in the last."""
    rng = np.random.default_rng(0)
    frames = sorted({*range(0, len(film.px), every), len(film.px) - 1})
    for frame in frames:
        for person, joint in np.argwhere(film.is_visible[frame]).tolist():
            yield frame, person, joint, film.px[frame, person, joint] + noise_px * rng.standard_normal(2)


def _rest_axes(bodies: Bodies) -> Array:
    """Return for each person and bone axes fixed to the bone in the frame of its parent's rotation, (P, bone, 3, 3)."""
    people = bodies.body22_m.shape[1]
    axes = np.zeros((people, len(BODY22.bones), 3, 3))
    for person in range(people):
        rotmat = rotmat_from_unitquat(bodies.unitquat[:, person])
        for bone, (parent, child) in enumerate(BODY22.bones):
            along = bodies.body22_m[:, person, child] - bodies.body22_m[:, person, parent]
            main = np.einsum("fji,fj->fi", rotmat[:, parent], along).mean(axis=0)
            main /= max(np.linalg.norm(main), 1e-9)
            side = np.cross(main, np.eye(3)[np.argmin(np.abs(main))])
            side /= np.linalg.norm(side)
            axes[person, bone] = np.stack([main, side, np.cross(main, side)], axis=1)
    return axes


def _draw(
    image: npt.NDArray[np.float32],
    drawn: npt.NDArray[np.float32],
    camera: PinholeCamera,
    ends: Array,
    radius: float,
    to_rest: Array,
    texture: npt.NDArray[np.float32],
) -> None:
    """Draw a capsule between two points in camera axes where nothing drawn is nearer."""
    height, width = drawn.shape
    cx, cy = camera.principal_point_px
    scale = camera.focal_px / -ends[:, 2]
    px = np.stack([cx + scale * ends[:, 0], cy - scale * ends[:, 1]], axis=-1)
    reach = 1.1 * radius * scale.max()
    x0, y0 = np.maximum(np.floor(px.min(axis=0) - reach).astype(int), 0)
    x1, y1 = np.minimum(np.ceil(px.max(axis=0) + reach).astype(int) + 1, [width, height])
    if x0 >= x1 or y0 >= y1 or radius <= 0:
        return
    x, y = np.meshgrid(np.arange(x0, x1, dtype=np.float32), np.arange(y0, y1, dtype=np.float32))
    ray = np.stack([(x - cx) / camera.focal_px, (cy - y) / camera.focal_px, -np.ones_like(x)], axis=-1)
    length = np.linalg.norm(ray, axis=-1)
    ray /= length[..., None]
    start, end = ends.astype(np.float32)
    # Nearest point of the ray to the axis gives a good first hit; then the sphere round that point of the axis.
    axis = end - start
    baba, oa = axis @ axis, -start
    bard, baoa, rdoa = ray @ axis, axis @ oa, ray @ oa
    a, b, c = baba - bard**2, baba * rdoa - baoa * bard, baba * (oa @ oa) - baoa**2 - radius**2 * baba
    h = b * b - a * c
    t = np.where(h >= 0, (-b - np.sqrt(np.maximum(h, 0))) / np.maximum(a, 1e-9), np.inf)
    along = baoa + np.where(np.isfinite(t), t, 0) * bard
    is_side = (h >= 0) & (along > 0) & (along < baba)
    t = np.where(is_side, t, np.inf)
    for cap in (start, end):
        b, c = -(ray @ cap), cap @ cap - radius**2
        h = b * b - c
        t = np.minimum(t, np.where((h > 0) & ~is_side, -b - np.sqrt(np.maximum(h, 0)), np.inf))
    depth = t / length
    box = drawn[y0:y1, x0:x1]
    is_hit = np.isfinite(t) & (depth < box)
    if not is_hit.any():
        return
    point = ray[is_hit] * t[is_hit, None]
    share = np.clip((point - start) @ axis / max(baba, 1e-9), 0, 1)
    normal = (point - start - share[:, None] * axis) / radius
    local = (point - start) @ to_rest.T.astype(np.float32)
    side = texture.shape[0]
    u = (local[:, 0] / 0.5 * side).astype(int) % side
    v = ((np.arctan2(local[:, 2], local[:, 1]) / (2 * np.pi) + 0.5) * side * radius * 2 * np.pi / 0.5).astype(
        int
    ) % side
    light = camera.camera_from_world_rotmat @ _LIGHT
    shade = 0.45 + 0.6 * np.maximum(normal @ light.astype(np.float32), 0)
    image[y0:y1, x0:x1][is_hit] = texture[v, u] * shade[:, None]
    box[is_hit] = depth[is_hit]


def _texture(rng: np.random.Generator, person: int, child: int) -> npt.NDArray[np.float32]:
    """Return cloth 0.5 m wide: folds and a weave round a colour."""
    name = BODY22.joint_names[child]
    colour = np.array(_COLOURS[person % 3], np.float32)
    if any(part in name for part in ("hip", "knee", "ankle", "toe")):
        colour = colour * 0.5 + 20
    if name in ("head", "neck") or "wrist" in name:
        colour = np.array([150, 175, 220], np.float32)
    side = 128
    grain = sum(
        weight
        * cv2.resize(
            rng.standard_normal((cells, cells)).astype(np.float32), (side, side), interpolation=cv2.INTER_CUBIC
        )
        for cells, weight in ((6, 12.0), (16, 14.0), (48, 8.0))
    )
    return np.clip(colour + np.asarray(grain)[..., None], 0, 255)


def _clutter(rng: np.random.Generator, size: tuple[int, int]) -> Image:
    """Return a wall full of things."""
    width, height = size
    cells = rng.uniform(60, 190, (height // 40 + 1, width // 40 + 1, 3)).astype(np.float32)
    image = cv2.resize(cells, size, interpolation=cv2.INTER_CUBIC)
    for _ in range(150):
        corner = rng.uniform([0, 0], size).astype(int)
        other = corner + rng.integers(8, height // 5, 2)
        colour = tuple(rng.uniform(20, 235, 3).tolist())
        if rng.random() < 0.5:
            cv2.rectangle(image, corner.tolist(), other.tolist(), colour, -1)
        else:
            cv2.ellipse(image, (corner.tolist(), (other - corner).tolist(), float(rng.uniform(0, 180))), colour, -1)
    return np.clip(image + rng.normal(0, 4, image.shape), 0, 255).astype(np.uint8)


def rows_of(film: Film, frames: list[int], *, hidden: float = 0.5) -> AnnotatedFrames:
    """Return the true joints of some frames; those that are hidden have a low confidence."""
    at = [(frame, person) for frame in frames for person in range(film.px.shape[1])]
    return AnnotatedFrames(
        "pair17",
        ("film",) * len(at),
        np.array([frame for frame, _ in at]),
        np.array([person for _, person in at]),
        np.stack([film.px[place] for place in at]),
        np.stack([np.where(film.is_visible[place], 1.0, hidden) for place in at]),
        rate_hz=30.0,
    )
