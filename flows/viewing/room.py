"""The room of a scene, the same in every browser: floor, bodies, contacts and cameras."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from flows.viewing.bodies import Bodies, marker_balls, marks
from flows.viewing.panel import Panel
from flows.viewing.scene import People, Scene
from pasdedeux.arrays import Array, Integers
from pasdedeux.cameras.pinhole import PinholeCamera
from pasdedeux.evaluation.pictures import person_rgb
from pasdedeux.spread import evenly_spread

COMPARE = ("overlay", "beside", "hidden")
"""Placement of the figures for comparison."""
VIEWS = {"side": (0.0, 0.4, 3.4), "front": (3.4, 0.4, 0.0), "top": (0.0, 3.4, 0.02)}
"""Positions of viewpoints, metres: along the line between two people, up, and across that line."""
_MARK_M = 0.035
_SEEN_THROUGH = 0.6
"""Opacity of bodies while contacts or penetrations are marked, most of which are inside them."""
_APART_M = 0.5
MOST_BESIDE = 4
"""Largest number of items side by side."""
_BESIDE_M = 1.8
_OVER_M = 1.1
"""Height of an item's name above the middle of its people."""
_MOVED_M = 2.0
"""Cameras move if people are further than this from the previous ones; height counts more."""
_UP_COUNTS = 4.0
_COLOURS = {"touch": (20, 160, 60), "through": (220, 20, 60)}
_FOV_RAD = float(np.deg2rad(75.0))
_BEHIND_M = 1.0
"""Distance of the screen for film behind the farthest joint."""
_GREY = (120, 120, 120)
_AMBIENT = 1.0
_DARKER = 1.5
"""Exponent of colours, because the lights of the room make them paler."""
_LINE = (200, 200, 200)
_MOST_FRAMES = 200
"""Largest number of frames searched for the closest moment, evenly spread."""
_CAMERA_M = 0.15
"""Depth of the outline that stands for a camera."""
_NO_POINTS = np.empty((0, 3))


@dataclass(frozen=True)
class _Put:
    """Nodes of bodies in the room: skins, and rods and balls of capsules."""

    skins: list[Any]
    rods: Any = None
    balls: Any = None


class Room:
    """Draws a scene.

    Args:
        panel: The panel, with the server of the viewer.
    """

    def __init__(self, panel: Panel) -> None:
        self._server = server = panel.server
        self._nodes: dict[str, Any] = {}
        self._groups: set[str] = set()
        # A rod along z, of radius and length 1; its ends are in balls.
        self._rod, self._ball, self._mark = _surface(np.ones(2), np.array([-0.5, 0.5]), 20), _ball(16), _ball(8)
        self._middle, self._across = np.full(3, np.inf), np.array([0.0, 1.0])
        self._grey: _Put | None = None
        self._more: list[tuple[_Put, Bodies, Scene]] = []
        server.scene.set_up_direction("+y")
        # Browsers without a GPU take three times as long with reflections, shadows and a shaded floor.
        server.scene.configure_environment_map(None)
        server.scene.configure_default_lights(cast_shadow=False)
        server.scene.add_light_ambient("/light", intensity=_AMBIENT)
        server.on_client_connect(panel.safely(self._aim, is_alone=False))

    def show(self, shown: Scene, where: str, more: Mapping[str, Scene] | None = None) -> None:
        """Show floor, bodies and camera of a scene, with the figures for comparison over or beside it.

        Further scenes stand on alternating sides, with their names above them.
        """
        scene, points = self._server.scene, shown.people.positions_m
        self._scene, self._bodies = shown, Bodies(shown.people, shown.ends_m, shown.radii_m, is_thin=shown.is_flat)
        self._behind = None if shown.behind is None else Bodies(shown.behind)
        flat = points.reshape(-1, 3)
        low, high = (np.nan_to_num(extreme.reduce(flat)) for extreme in (np.fmin, np.fmax))  # neither copies
        floor = 0.0 if shown.has_floor and abs(low[1]) < 1.0 else float(low[1])
        middle = np.array([np.round((low[0] + high[0]) / 2), floor, np.round((low[2] + high[2]) / 2)])
        size = float(2 * np.ceil(max(high[0] - low[0], high[2] - low[2]) / 2) + 6)
        scene.add_line_segments("/floor", _grid(size), _LINE, thickness=1.5, thickness_units="screen", position=middle)
        self._across = across(shown.people)
        first = points[np.argmax(np.isfinite(points[..., 0]).any(axis=(1, 2)))].reshape(-1, 3)  # with people
        start = np.nan_to_num(first[np.isfinite(first).all(axis=-1)].mean(axis=0)) if np.isfinite(first).any() else low
        middle = np.array([start[0], floor + 0.9, start[2]])
        if np.linalg.norm((middle - self._middle) * [1.0, _UP_COUNTS, 1.0]) > _MOVED_M:
            self._middle = middle
            for client in self._server.get_clients().values():
                self._aim(client)
        for name in self._groups:
            self._show_node(name, is_shown=False)
        self._people = self._put_bodies("/people", self._bodies)
        places, sizes = marker_balls((_NO_POINTS,) * 2, _MARK_M)
        both = np.repeat(np.array(list(_COLOURS.values()), dtype=np.uint8), len(places) // 2, axis=0)
        self._marks = self._instances("/marks/balls", places, sizes, both)
        self._grey = None
        apart = max(float(high[0] - low[0]), float(high[2] - low[2])) + _APART_M if where == "beside" else 0.0
        if self._behind is not None and where != "hidden":
            opacity = {} if apart else {"opacity": 0.3}
            self._grey = self._put_bodies(f"/{where}", self._behind, _GREY, apart, **opacity)
        self._more = []
        for number, (label, other) in enumerate((more or {}).items(), 1):
            bodies, away = Bodies(other.people), _BESIDE_M * ((number + 1) // 2) * (1 if number % 2 else -1)
            self._more.append((self._put_bodies(f"/more{number}", bodies, None, away), bodies, other))
            over = self._middle + self._to_right(away) + [0.0, _OVER_M, 0.0]
            scene.add_label(f"/names/{number}", label, position=over, anchor="bottom-center")
        for number in range(len(self._more) + 1, MOST_BESIDE):
            self._show_node(f"/names/{number}", is_shown=False)
        self._show_node("/film", is_shown=False)
        self._film: Any = None
        self._show_node("/camera", is_shown=shown.camera is not None)
        if shown.camera is not None:
            wxyz, position, fov = _view_of(shown.camera)
            width, height = shown.camera.image_size_px
            scene.add_camera_frustum(
                "/camera", fov, width / height, scale=_CAMERA_M, thickness=0.005,
                color=_GREY, wxyz=wxyz, position=position,
            )  # fmt: skip
            self._far_m = float(-np.nanmin(shown.camera.camera_from_world(flat)[:, 2])) + _BEHIND_M

    def show_frame(self, frame: int, pose: Array | None, *, has_marks: bool) -> tuple[int, int]:
        """Send the bodies of a frame; return how many contacts and penetrations are marked.

        Args:
            frame: The frame.
            pose: Positions (person, joint, 3), metres, in place of those of the scene.
            has_marks: Whether contacts and penetrations are marked.
        """
        scene, touch, through = self._scene, _NO_POINTS, _NO_POINTS
        if has_marks and not scene.is_flat:
            shown = scene.people.frame(frame) if pose is None else pose
            touch, through = marks(scene.people.skeleton, shown, self._bodies.radii_m)
        with self._server.atomic():
            _move(self._people, self._bodies, frame, pose)
            if self._behind is not None and self._grey is not None and scene.behind is not None:
                _move(self._grey, self._behind, min(frame, len(scene.behind.positions_m) - 1))
            for put, bodies, other in self._more:
                _move(put, bodies, min(frame, other.num_frames - 1))
            places, sizes = marker_balls((touch, through), _MARK_M)
            _place(self._marks, places, sizes)
            opacity = _SEEN_THROUGH if len(touch) + len(through) else None
            for skin in self._people.skins:
                if skin.opacity != opacity:
                    skin.opacity = opacity
        return len(touch), len(through)

    def show_film(self, image: Array | None) -> None:
        """Show the camera's image on a screen behind people, so that they match it when seen through the camera."""
        camera = self._scene.camera
        if image is None or camera is None:
            self._show_node("/film", is_shown=False)
        elif self._film is None:
            wxyz, position, _ = _view_of(camera)
            width, height = (self._far_m * side / camera.focal_px for side in camera.image_size_px)
            middle = (np.array(camera.image_size_px) / 2 - camera.principal_point_px) * [1.0, -1.0] / camera.focal_px
            centre = position + self._far_m * np.array([*middle, -1.0]) @ camera.camera_from_world_rotmat
            self._film = self._server.scene.add_image("/film", image, width, height, wxyz=wxyz, position=centre)
        else:
            self._film.image, self._film.visible = image, True

    def look_through(self, client: Any) -> None:
        """Give a browser the view of the scene's camera."""
        if self._scene.camera is not None and client is not None:
            wxyz, position, fov = _view_of(self._scene.camera)
            self._middle = np.full(3, np.inf)  # the next item gets a good view again
            with client.atomic():
                client.camera.fov, client.camera.wxyz, client.camera.position = fov, wxyz, position

    def _put_bodies(
        self, where: str, bodies: Bodies, grey: tuple[int, int, int] | None = None, away: float = 0.0, **more: Any
    ) -> _Put:
        """Show bodies, with existing nodes if the number of capsules is the same."""
        here, colours, name = bodies.at(0), bodies.colours(grey), f"{where}/{len(bodies.radii_m)}"
        if name not in self._groups:
            self._groups.add(name)
            self._server.scene.add_frame(name, show_axes=False)
        frame = self._server.scene.get_handle_by_name(name)
        frame.visible, frame.position = True, self._to_right(away)
        skins = []
        for at, body in enumerate(bodies.skins):
            upright = np.tile([1.0, 0.0, 0.0, 0.0], (len(body.rest_m), 1))
            skins.append(
                self._server.scene.add_mesh_skinned(
                    f"{name}/skin{at}", body.vertices_m.astype(np.float32), body.faces.astype(np.uint32),
                    bone_wxyzs=upright, bone_positions=body.rest_m, skin_weights=body.weights.astype(np.float32),
                    color=grey or person_rgb(at), cast_shadow=False, receive_shadow=False, **more,
                )
            )  # fmt: skip
        rods, balls = f"{name}/{len(colours)}/rods", f"{name}/{len(colours)}/balls"
        for node in [node for node in self._nodes if node.startswith(f"{name}/")]:
            self._show_node(node, is_shown=node in (rods, balls))
        if not len(colours):
            return _Put(skins)
        return _Put(
            skins,
            self._instances(rods, here.rods_m, here.rods_scale, colours, **more),
            self._instances(balls, here.balls_m, here.balls_scale, np.repeat(colours, 2, 0), **more),
        )

    def _instances(self, name: str, places: Array, sizes: Array, colours: Any, **more: Any) -> Any:
        """Show instances of rods or balls, with existing nodes if there are some."""
        pale = _pale(colours)
        if (handle := self._nodes.get(name)) is not None:
            handle.batched_positions, handle.batched_scales, handle.batched_colors = places, sizes, pale
            return handle
        mesh = self._rod if name.endswith("rods") else self._mark if name.startswith("/marks") else self._ball
        turns = np.tile(np.array([1.0, 0.0, 0.0, 0.0], dtype=np.float32), (len(places), 1))
        self._nodes[name] = self._server.scene.add_batched_meshes_simple(
            name, mesh.vertices, mesh.faces, turns, places, batched_scales=sizes, batched_colors=pale, lod="off",
            cast_shadow=False, receive_shadow=False, **more,
        )  # fmt: skip
        return self._nodes[name]

    def _show_node(self, name: str, *, is_shown: bool) -> None:
        handle = self._server.scene.get_handle_by_name(name)
        if handle is not None:
            handle.visible = is_shown

    def _aim(self, client: Any) -> None:
        """Point a browser's camera at the people; on a narrow page above the panel, which takes the lower half."""
        is_narrow = client.camera.image_width < client.camera.image_height
        with client.atomic():
            client.camera.fov = _FOV_RAD
            client.camera.position = self._place(*((0.0, 0.6, 7.0) if is_narrow else (0.5, 0.7, 3.4)))
            client.camera.look_at = self._place(*((0.0, -2.4, 0.0) if is_narrow else (0.5, -0.1, 0.0)))

    def view(self, client: Any, name: str) -> None:
        """Point a browser's camera at the people from one of `VIEWS`."""
        with client.atomic():
            client.camera.position, client.camera.look_at = self._place(*VIEWS[name]), self._middle

    def _to_right(self, away: float) -> Array:
        """Return a displacement along the line between the two people, to the right of a viewer across it."""
        return away * np.array([self._across[1], 0.0, -self._across[0]])

    def _place(self, right: float, up: float, near: float) -> Array:
        """Return a position relative to the middle of the people, metres; `near` is across the line between them."""
        x, z = self._across
        return np.asarray(self._middle + np.array([right * z + near * x, up, near * z - right * x]))


def across(people: People) -> Array:
    """Return the horizontal unit vector (x, z), z > 0, across the line between the first two people.

    It is that of the frame in which they are nearest; (0, 1) for fewer people.
    """
    every = people.positions_m
    frames = evenly_spread(len(every), _MOST_FRAMES)
    if every.shape[1] < 2 or not np.isfinite(every[frames, :2]).all(axis=(1, 2, 3)).any():
        return np.array([0.0, 1.0])
    pairs = every[frames, :2].astype(np.float64)
    away = np.linalg.norm(pairs[:, 0, :, None] - pairs[:, 1, None], axis=-1).min(axis=(1, 2))
    first, other = np.nanmean(pairs[int(np.nanargmin(away))], axis=1)[:, [0, 2]]
    line = (other - first) / max(float(np.linalg.norm(other - first)), 1e-9)
    direction = np.array([-line[1], line[0]])
    return direction if direction[1] > 0 else -direction if line.any() else np.array([0.0, 1.0])


def _grid(size: float) -> Array:
    """Return the lines (n, 2, 3) of a square grid of metres on the floor around the origin."""
    at = np.arange(-size / 2, size / 2 + 0.5)
    x, z = (axis.ravel() for axis in np.meshgrid(at, at[:-1]))
    along = np.stack([np.stack([x, 0 * x, z], axis=-1), np.stack([x, 0 * x, z + 1.0], axis=-1)], axis=1)
    return np.concatenate([along, along[..., ::-1]]).astype(np.float32)


@dataclass(frozen=True)
class _Mesh:
    """Corners (n, 3) and triangles (m, 3) of a surface."""

    vertices: Array
    faces: Integers


def _surface(radii: Array, heights: Array, sides: int) -> _Mesh:
    """Return a surface of revolution around z, closed if its radii end with 0."""
    angle = 2 * np.pi * np.arange(sides) / sides
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    corners = [np.column_stack([radius * ring, np.full(sides, z)]) for radius, z in zip(radii, heights, strict=True)]
    row, at = np.mgrid[: len(radii) - 1, :sides]
    here, beside = row * sides + at, row * sides + (at + 1) % sides
    faces = np.concatenate(
        [np.stack([here, beside, beside + sides], -1), np.stack([here, beside + sides, here + sides], -1)]
    )
    return _Mesh(np.concatenate(corners), faces.reshape(-1, 3))


def _ball(sides: int) -> _Mesh:
    """Return a ball of radius 1."""
    latitude = np.linspace(-np.pi / 2, np.pi / 2, sides // 2 + 1)
    return _surface(np.cos(latitude), np.sin(latitude), sides)


def _pale(colours: Array) -> Array:
    """Return the colours, 0 to 255, that look like these under the room's lights."""
    return np.asarray((255.0 * (colours / 255.0) ** _DARKER).astype(np.uint8))


def _move(put: _Put, bodies: Bodies, frame: int, pose: Array | None = None) -> None:
    """Move bodies to a frame, or to other positions (person, joint, 3), metres."""
    for skin, (turns, places) in zip(put.skins, bodies.turns(frame, pose), strict=True):
        for bone, turn, place in zip(skin.bones, turns, places, strict=True):
            bone.wxyz, bone.position = turn, place
    if put.rods is not None:
        capsules = bodies.at(frame, pose)
        put.rods.batched_wxyzs = capsules.rods_wxyz
        _place(put.rods, capsules.rods_m, capsules.rods_scale)
        _place(put.balls, capsules.balls_m, capsules.balls_scale)


def _place(instances: Any, places: Array, sizes: Array) -> None:
    """Move and scale instances."""
    instances.batched_positions, instances.batched_scales = places, sizes


def _view_of(camera: PinholeCamera) -> tuple[Array, Array, float]:
    """Return rotation (w, x, y, z), looking along z with y down, position and vertical field of view of a camera."""
    world_from_camera = camera.camera_from_world_rotmat.T @ np.diag([1.0, -1.0, -1.0])
    turn = Rotation.from_matrix(world_from_camera).as_quat()
    return turn[[3, 0, 1, 2]], camera.position_m, float(2 * np.arctan(camera.image_size_px[1] / 2 / camera.focal_px))
