"""Reconstruction as frames arrive: each pose leaves a fixed number of frames after its image, and is never changed.

The poses of a person's first two seconds leave together, once the bones are known (`SETTLING_S`).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.errors import InputError
from pasdedeux.people.identity import MAX_ABSENT_S, Follower
from pasdedeux.reconstruction.live.cleanup import LiveFloor
from pasdedeux.reconstruction.live.person import PROPORTIONS_EVERY, LiveOptions, LivePerson, LivePose
from pasdedeux.reconstruction.matching import Searcher
from pasdedeux.reconstruction.tracks import Lens

EVERYBODY_ELSE = -1
"""Key of the stature of everybody without their own."""


class LivePeople:
    """All people of a video as frames arrive: tracked by identity, each reconstructed separately.

    Args:
        searcher: Prepared database.
        rate_hz: Frames per second.
        image_size_px: Width and height; estimated from the first people seen if not given.
        focal_px: Focal length, if known.
        statures_m: Statures by person id; under `EVERYBODY_ELSE`, that of the others.
        options: Settings.

    Attributes:
        person_ids: Everybody seen so far.
    """

    def __init__(
        self,
        searcher: Searcher,
        *,
        rate_hz: float,
        image_size_px: tuple[int, int] | None = None,
        focal_px: float | None = None,
        statures_m: Mapping[int, float] | None = None,
        options: LiveOptions | None = None,
    ) -> None:
        self._options = options or LiveOptions()
        self._searcher = searcher
        self._rate_hz = rate_hz
        self._size, self._focal_px = image_size_px, focal_px
        self._statures_m = statures_m or {}
        self._lens: Lens | None = None
        self._follower = Follower()
        self.person_ids: set[int] = set()
        self._people: dict[int, LivePerson] = {}
        self._last_seen: dict[int, int] = {}
        self._last_frame: int | None = None
        self._floor = LiveFloor(rate_hz)

    @property
    def camera_from_upright_rotmat(self) -> Array:
        """Rotation from upright axes to those of the pitched camera (3, 3)."""
        return self._searcher.database.camera.camera_from_upright_rotmat

    def push(self, frame: int, keypoints_px: Array, confidence: Array) -> list[LivePose]:
        """Add the detections of a frame (detection, 14, 2), in any order; return the poses that are due."""
        if self._last_frame is not None and frame <= self._last_frame:
            raise InputError(f"frame {frame} comes after frame {self._last_frame}; frames must come in order")
        self._last_frame = frame
        followed = self._follower.step(frame / self._rate_hz, keypoints_px, confidence)
        if self._lens is None and (followed.track_id >= 0).any():
            width, height = self._size or (None, None)
            self._lens = Lens.assumed(width, height, followed.keypoints_px, self._focal_px)
        poses: list[LivePose] = []
        at = {int(person): index for index, person in enumerate(followed.track_id) if person >= 0}
        for person in at:
            if person not in self._people and self._lens is not None:
                self.person_ids.add(person)
                self._people[person] = LivePerson(
                    person,
                    self._searcher,
                    rate_hz=self._rate_hz,
                    lens=self._lens,
                    options=self._options,
                    floor=self._floor,
                    stature_m=self._statures_m.get(person, self._statures_m.get(EVERYBODY_ELSE)),
                )
        for person in sorted(self._people):
            if person in at:
                self._last_seen[person], row = frame, at[person]
                poses += self._people[person].push(frame, followed.keypoints_px[row], followed.confidence[row])
            else:
                poses += self._people[person].advance(frame)
        forgotten = frame - MAX_ABSENT_S * self._rate_hz - self._options.lag
        for person in [name for name, last in self._last_seen.items() if last < forgotten]:
            poses += self._people.pop(person).finish()
            del self._last_seen[person]
            self._floor.forget(person)
        return poses

    def finish(self) -> list[LivePose]:
        """Return all poses that still wait."""
        return [pose for person in sorted(self._people) for pose in self._people[person].finish()]


def load_kernels(searcher: Searcher, options: LiveOptions | None = None) -> None:
    """Load compiled kernels before the first image: pass a pose of the database through a separate chain."""
    options = options or LiveOptions()
    options = options.model_copy(update={"lag": min(options.lag, 6)})
    people = LivePeople(searcher, rate_hz=30.0, image_size_px=(1920, 1080), options=options)
    pose = searcher.database.turned(np.zeros(1, dtype=np.int64), np.zeros(1))
    px = searcher.database.camera.project(pose) * np.array([300.0, -300.0]) + np.array([960.0, 540.0])
    for frame in range(PROPORTIONS_EVERY + options.lag):
        people.push(frame, px, np.ones(px.shape[:-1]))
    people.finish()
