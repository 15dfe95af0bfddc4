"""Changes pairs in the viewer: joints are dragged, the pair is saved as a seed, and chains start from it."""

from __future__ import annotations

import hashlib
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from flows.viewing.shelf import ViewedPartition
from flows.viewing.side_picture import Dragged
from flows.viewing.table_views import IMAGE_HEIGHT_M, TABLE_VIEWS, placed_in_room
from flows.viewing.viewer import Viewer
from pasdedeux.arrays import Array
from pasdedeux.errors import InputError
from pasdedeux.fitting.dragging import pull_joint
from pasdedeux.formats.pair_file import write_pair_json
from pasdedeux.formats.poses2d.annotated_frames import AnnotatedFrames
from pasdedeux.formats.poses2d.annotation_csv import write_annotation_csv
from pasdedeux.plausibility.joint_limits import JointLimits
from pasdedeux.plausibility.ranges import ANGLES
from pasdedeux.skeletons import PAIR17
from storage_schema import ArtifactRef
from tasks.files.curation import POSITIONS
from tasks.ingest.film.resolution import CorrectedShot
from tasks.lifting import lift_again
from tasks.priors import read_limits
from tasks.seeds.files import pair_in_store

_PERSONS = ("A", "B")
_TOO_FAR = 6
_NUM_NEXT = 8
"""Frames of a shot to correct next."""


class Editor:
    """The folder of the panel in which pairs are changed and chains are started.

    Args:
        viewer: The viewer.
        out: Folder for the files that are saved.
        num_workers: Workers of a restart; None: the default of `pasdedeux restart`.
    """

    def __init__(self, viewer: Viewer, out: Path, num_workers: int | None = None) -> None:
        self.viewer, self.out, self._num_workers = viewer, out, num_workers
        self.process: subprocess.Popen[str] | None = None
        panel, gui = viewer.panel, viewer.server.gui
        with gui.add_folder("Change and restart", expand_by_default=False) as self._folder:
            self._is_on = gui.add_checkbox("change this pair", initial_value=False)
            self._person = gui.add_dropdown("person", _PERSONS)
            self._joint = gui.add_dropdown("joint", PAIR17.joint_names, initial_value="left_wrist")
            self._limits = gui.add_text("joint limits", "", disabled=True)
            self._next = panel.button("Next frame to correct", lambda _: self.next_to_correct())
            self._save = panel.button("Save as seed", lambda _: panel.tell(f"saved: {self.save()}"))
            self._lift = panel.button("Lift again", lambda _: self.lift())
            self._restart = panel.button("Restart chains from here", lambda _: self.restart())
            self._progress = gui.add_text("restart", "", disabled=True)
        self._hand = viewer.server.scene.add_transform_controls(
            "/hand", scale=0.3, disable_rotations=True, depth_test=False, visible=False
        )
        self._hand.on_update(
            panel.safely(lambda event: self.drag(np.array(self._hand.position), is_last=event.phase == "end"))
        )
        self._is_on.on_update(panel.safely(lambda _: self._begin()))
        for handle in (self._person, self._joint):
            handle.on_update(panel.safely(lambda _: self.show_hand()))
        viewer.on_moment.append(self.show_hand)
        self.show_hand()

    @property
    def is_image(self) -> bool:
        """Whether 2D joints are changed."""
        return self.viewer.part.table == "annotations"

    def _begin(self) -> None:
        """Begin or end changes; 2D poses are shown as such meanwhile."""
        viewer = self.viewer
        viewer.wants_flat = bool(self._is_on.value)
        if viewer.scene.flat is not None:
            viewer.show_item(viewer.index, viewer.moment.row)
        self.show_hand()

    def show_hand(self) -> None:
        """Show the controls that apply to the scene, and the handle at the chosen joint."""
        viewer = self.viewer
        num_people = self.pose.shape[0]
        can_change = TABLE_VIEWS[viewer.part.table].is_each and num_people == len(_PERSONS)
        can_change = can_change or (self.is_image and num_people <= len(_PERSONS))
        is_on = can_change and bool(self._is_on.value) and self.pose.shape[1] == PAIR17.num_joints
        is_on = is_on and self.is_image is (viewer.scene.flat is not None)
        self._folder.visible = can_change
        self._save.label = "Save the 2D poses" if self.is_image else "Save as seed"
        self._lift.visible, self._restart.visible = self.is_image, viewer.part.table == "draws"
        self._lift.label = "Lift again" if viewer.scene.flat is not None else "Back to the 2D poses"
        self._save.visible = not self.is_image or is_on
        self._next.visible = is_on and self._shot_ref is not None
        self._hand.visible = is_on
        viewer.side.on_drag = self._drag_image if is_on and self.is_image else None
        if not is_on:
            return
        viewer.play(is_playing=False)
        person = min(_PERSONS.index(self._person.value), num_people - 1)
        self._place = viewer.side.chosen = person, PAIR17.index(self._joint.value)
        at = self.pose[self._place]
        self._hand.position = np.where(np.isfinite(at), at, 0.0)
        self.show_limits()

    @property
    def pose(self) -> Array:
        """The current pair (person, joint, 3), metres."""
        viewer = self.viewer
        return viewer.scene.people.frame(viewer.frame) if viewer.pose is None else viewer.pose

    def drag(self, target_m: Array, *, is_last: bool = True) -> None:
        """Move the chosen joint to a place, with exact bones of pairs; film is tracked again after the last move."""
        if not self._hand.visible:
            return
        viewer, (person, joint) = self.viewer, self._place
        pose = self.pose.copy()
        if self.is_image:
            pose[person, joint] = [*target_m[:2], 0.0]
        else:
            pose = pull_joint(PAIR17, pose, person, joint, target_m)
        viewer.pose = pose
        viewer.show_frame()
        if self.is_image:
            viewer.image_px = self.image_px()
            viewer.look()
        self.show_limits()
        if is_last:
            self._track_anew()

    def _drag_image(self, dragged: Dragged) -> None:
        """Move a joint that is dragged in the side picture, and the handle with it."""
        self._person.value, self._joint.value = _PERSONS[dragged.person], PAIR17.joint_names[dragged.joint]
        self._place = dragged.person, dragged.joint
        self._hand.position = at = np.array([*placed_in_room(dragged.point_px, self._size_px), 0.0])
        self.drag(at, is_last=dragged.is_last)

    # Film: tracks follow corrections.

    @property
    def _shot_ref(self) -> ArtifactRef | None:
        """The artifact of the shown shot of film; None for other 2D poses."""
        ref = self.viewer.item.pieces[0][0]
        is_shot = self.is_image and "num_given" in self.viewer.shelf.store.manifest(ref).parameters
        return ref if is_shot else None

    def _track_anew(self) -> None:
        """Treat the released joint of film as annotated, and track it again from there."""
        viewer, ref = self.viewer, self._shot_ref
        if ref is None or viewer.pose is None:
            return
        shot, (person, joint) = self._tracked(ref), self._place
        row = viewer.moment.row
        data = viewer.item.read(viewer.shelf.store, "annotations", ["frame", "person_id"])
        frame = shot.film_frame(int(data["frame"][row]))
        name, person_id = PAIR17.joint_names[joint], int(np.unique(data["person_id"])[person])
        shot.correct(frame, person_id, name, self.image_px()[person, joint])
        viewer.shelf.corrected[ref] = shot.changes_px()
        viewer.show_item(viewer.index, row)
        viewer.panel.tell(
            f"{name} of {_PERSONS[person]} is now annotated in frame {frame} of the film; its track follows"
        )

    def next_to_correct(self) -> None:
        """Go to the next frame of film whose correction helps most."""
        viewer, ref = self.viewer, self._shot_ref
        if ref is None:
            return
        wanted = self._tracked(ref).next_frames(_NUM_NEXT)
        numbers = np.unique(viewer.item.read(viewer.shelf.store, "annotations", ["frame"])["frame"])
        at = sorted(int(number) for number in np.searchsorted(numbers, wanted) if number < len(numbers))
        if not at:
            viewer.panel.tell("nothing to correct: the tracks from both sides agree")
            return
        viewer.seek(next((frame for frame in at if frame > viewer.frame), at[0]))
        viewer.panel.tell(f"frames to correct, most useful first: {' '.join(map(str, wanted))}")

    def _tracked(self, ref: ArtifactRef) -> CorrectedShot:
        self.viewer.panel.tell("tracking the joints of this shot (once)")
        return self.viewer.shelf.shot(ref)

    def show_limits(self) -> None:
        """List the angles that are out of range."""
        refs = self.viewer.shelf.having("joint_limits")
        limits = read_limits(self.viewer.shelf.store, refs) if refs else JointLimits.published()
        bad = [
            f"{_PERSONS[person]} {ANGLES[angle].joint} {ANGLES[angle].angle}"
            for person, angle in np.argwhere(limits.invalid_angles(self.pose))
        ]
        more = f" and {len(bad) - _TOO_FAR} more" if len(bad) > _TOO_FAR else ""
        self._limits.visible = not self.is_image
        self._limits.value = f"{', '.join(bad[:_TOO_FAR])}{more} out of range" if bad else "all angles in range"

    # Saving.

    def save(self) -> Path:
        """Write the current pair or 2D poses to a file for studies, and return its path."""
        if self.is_image:
            path = self._save_image()
        else:
            viewer = self.viewer
            ref, row = viewer.item.row(viewer.moment.row)
            edited = pair_in_store(viewer.shelf.store, viewer.part.table, ref, row)
            is_changed = viewer.pose is not None
            said = f"{edited.made_from}{', joints moved by hand' if is_changed else ''}"
            pair = replace(edited, pair_m=self.pose if is_changed else edited.pair_m, made_from=said)
            path = self._write(f"{viewer.part.table}-{ref.key[:12]}-{row}", ".json", write_pair_json(pair))
        return path

    def _write(self, name: str, suffix: str, text: str) -> Path:
        """Write a file with a digest of its content in its name, so that earlier files stay."""
        self.out.mkdir(parents=True, exist_ok=True)
        path = self.out / f"{name}-{hashlib.sha256(text.encode()).hexdigest()[:6]}{suffix}"
        path.write_text(text, encoding="utf-8")
        return path

    # Chains.

    def restart(self) -> None:
        """Start chains from the shown pair in a separate process, which does not depend on the browser."""
        viewer = self.viewer
        if self.process is not None and self.process.poll() is None:
            raise InputError("a restart is already running; wait until it ends")
        ref, row = viewer.item.row(viewer.moment.row)
        seed = self.save()
        words = ["restart", f"draws@{ref.content_digest[:16]}#{row}", "--edited", str(seed)]
        words += ["--store", str(viewer.shelf.store)]
        words += [] if self._num_workers is None else ["--workers", str(self._num_workers)]
        self._progress.value = "starting"
        self.process = subprocess.Popen(
            [sys.executable, "-m", "flows.console", *words], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        follow = viewer.panel.safely(lambda process: self._follow(process, seed.name), is_alone=False)
        threading.Thread(target=follow, args=(self.process,), daemon=True).start()

    def _follow(self, process: subprocess.Popen[str], seed: str) -> None:
        """Show the output of the process line by line, and offer new draws while they come."""
        assert process.stdout is not None
        before = set(self.viewer.shelf.store.folders("chains"))
        last = ""
        with process.stdout as lines:
            for line in lines:
                last = line.strip() or last
                self._progress.value = last
                self._offer(before, seed)
        self._progress.value = f"{'done' if process.wait() == 0 else 'failed'}: {last}"
        self._offer(before, seed)

    def _offer(self, before: set[Path], seed: str) -> None:
        """Add new draws from a seed file to the shelf, with a part for each partition."""
        viewer, store = self.viewer, self.viewer.shelf.store
        refs_by_stage: dict[str, list[ArtifactRef]] = {}
        for path in sorted(set(store.folders("chains")) - before):
            manifest = store.find("chains", path.name)
            if manifest is not None and "draws" in manifest.tables:
                names = {name for ref in manifest.inputs for name, _ in store.manifest(ref).files}
                if seed in names:
                    refs_by_stage.setdefault(f"restart {Path(seed).stem} {manifest.partition}", []).append(manifest.ref)
        with viewer.lock:
            new = [ViewedPartition("draws", name, tuple(refs)) for name, refs in refs_by_stage.items()]
            if set(new) - set(viewer.shelf.parts):
                viewer.shelf.parts = [part for part in viewer.shelf.parts if part.name not in refs_by_stage] + new
                viewer.shown.offer_parts(viewer.shelf.parts, viewer.part)

    # 2D poses.

    def lift(self) -> None:
        """Lift the current 2D poses of this frame again, and show the pair with the previous one."""
        viewer, shelf = self.viewer, self.viewer.shelf
        if viewer.scene.flat is None:
            viewer.show_item(viewer.index, viewer.moment.row)
            return
        viewer.wants_flat = True
        if viewer.scene.people is not viewer.scene.flat:
            viewer.show_item(viewer.index, viewer.moment.row)
        row = viewer.moment.row
        ref, _ = viewer.item.row(row)
        views = [candidate for candidate in shelf.having("views") if ref in shelf.store.manifest(candidate).inputs]
        if not views:
            raise InputError("the study has no views of these annotations, so they cannot be lifted")
        place = viewer.item.read(shelf.store, "annotations", ["sequence_id", "frame"])
        moment = str(place["sequence_id"][row]), int(place["frame"][row])
        at_hand = [*shelf.having("draws"), *shelf.having("seeds")]
        before, after = lift_again(shelf.store, ref, views[0], at_hand, moment, self.image_px())
        viewer.show_beside(after, before)
        moved = 100.0 * float(np.linalg.norm(after - before, axis=-1).mean())
        viewer.panel.tell(f"lifted again: joints moved by {moved:.1f} cm on average; grey is the pair of before")

    def image_px(self) -> Array:
        """Return the current 2D poses (person, joint, 2), pixels."""
        width, height = self._size_px
        return np.asarray(self.pose[..., :2] * [1.0, -1.0] * height / IMAGE_HEIGHT_M + [width / 2, height])

    @property
    def _size_px(self) -> tuple[int, int]:
        return self.viewer.scene.images(self.viewer.frame)[0].size_px

    def _save_image(self) -> Path:
        """Write all 2D poses of the item, with the changes in this frame, as CSV; for film its key frames."""
        viewer = self.viewer
        if self._shot_ref is not None:
            keys = write_annotation_csv(viewer.shelf.shot(self._shot_ref).given())
            return self._write(f"keys-{viewer.item.names[0].replace('/', '.')}", ".csv", keys)
        names = ["sequence_id", "frame", "person_id", POSITIONS["annotations"], "pair17_confidence"]
        data: Any = viewer.item.read(viewer.shelf.store, "annotations", names)
        points = np.array(data["pair17_px"], dtype=np.float64)
        is_shown = viewer.scene.frame_of_row == viewer.frame
        points[is_shown] = self.image_px()[np.argsort(np.argsort(data["person_id"][is_shown]))]
        confidence = np.where(np.isfinite(points).all(axis=-1), np.maximum(data["pair17_confidence"], 1e-3), 0.0)
        sequences = tuple(name.replace("/", ".") for name in data["sequence_id"])
        frames = AnnotatedFrames(
            layout=PAIR17.name,
            sequence_id=sequences,
            frame=np.asarray(data["frame"], dtype=np.int64),
            person_id=np.asarray(data["person_id"], dtype=np.int64),
            keypoints_px=points,
            confidence=confidence,
            image_size_px=dict.fromkeys(sequences, self._size_px),
            rate_hz=viewer.scene.rate_hz,
        )
        return self._write(
            f"annotations-{viewer.item.names[0].replace('/', '.')}", ".csv", write_annotation_csv(frames)
        )
