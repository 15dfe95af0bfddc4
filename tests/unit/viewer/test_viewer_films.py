"""2D poses and their films in the viewer: the image of a frame, films that changed, joints that are corrected."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from flows.exports.overlay_video import FilmImages
from flows.viewing.editing import Editor
from flows.viewing.films import FilmReader, find_film
from flows.viewing.footage import LIMBS17, LIMBS22, SequenceFootage
from flows.viewing.scene import Grid
from flows.viewing.shelf import Shelf, ViewedPartition
from flows.viewing.side_picture import Dragged
from flows.viewing.table_views import TABLE_VIEWS
from flows.viewing.viewer import Viewer
from pasdedeux.cameras.virtual_video import look_at_camera
from pasdedeux.errors import InputError
from pasdedeux.formats.poses2d.annotated_frames import KeypointStatus
from pasdedeux.formats.poses2d.annotation_csv import read_annotation_csv
from pasdedeux.skeletons import BODY22, PAIR17
from pasdedeux.skeletons.layouts import KEYPOINT_LAYOUTS
from storage_schema import Manifest, Store
from tasks.files.user_files import user_file_digest
from tasks.ingest.film.parameters import FilmOptions
from tasks.ingest.film.readers import FilmFrame, open_film, read_film
from tasks.ingest.film.run import find_videos
from tasks.stage import SourceFile
from tasks.stage.facts import SequenceFacts
from tests.builders.ingest_runs import planned, run
from tests.builders.mp4_boxes import with_durations
from tests.builders.painted_film import painted, write_keys
from tests.builders.rendered_film import write_film
from tests.builders.storage_rows import put, random_columns

OpenViewer = Callable[..., Viewer]


def test_the_image_of_2d_poses_has_the_size_of_its_own_sequence(tmp_path: Path) -> None:
    places = {"sequence_id": ["small", "small", "large", "large"], "frame": [0] * 4, "person_id": [0, 1, 0, 1]}
    columns = random_columns("annotations", 4) | places | {"partner_id": [1, 0, 1, 0]}
    columns |= {"image_width_px": [640, 640, 1920, 1920], "image_height_px": [480, 480, 1080, 1080]}
    columns["pair17_px"] = np.random.default_rng(0).uniform(0.0, 400.0, (4, 17, 2))
    store = Store(tmp_path / "store")
    ref = put(store, "ingest", "images", {"annotations": columns}, {}).ref
    for name, size in {"small": (640, 480), "large": (1920, 1080)}.items():
        assert [flat.size_px for flat in SequenceFootage(store, ref, name).flats(0, name)] == [size]


WRIST = PAIR17.index("left_wrist")


def begin(editor: Editor, frame: int) -> Callable[[Dragged], object]:
    """Begin to change what is shown in a frame; return what a joint is dragged with."""
    editor._is_on.value = True
    editor._begin()
    editor.viewer.seek(frame)
    drag = editor.viewer.side.on_drag
    assert drag is not None
    return drag


def annotated(store: Store, name: str, places: dict[str, list[object]], points_px: np.ndarray) -> Manifest:
    """Return an artifact of 2D poses in images of 640 by 480 pixels, of one partition."""
    columns = random_columns("annotations", len(points_px)) | {"is_key": [True] * len(points_px)} | places
    columns |= {"image_width_px": [640] * len(points_px), "image_height_px": [480] * len(points_px)}
    facts = SequenceFacts(rate_hz=30.0, sequence_ids=tuple(dict.fromkeys(map(str, places["sequence_id"]))))
    return put(
        store, "ingest", name, {"annotations": columns | {"pair17_px": points_px}}, facts.model_dump(mode="json")
    )


def test_saved_2d_poses_differ_only_where_they_were_changed(tmp_path: Path, open_viewer: OpenViewer) -> None:
    rng = np.random.default_rng(4)
    places = {"sequence_id": ["walk"] * 6, "person_id": [9, 4] * 3, "partner_id": [4, 9] * 3}
    places |= {"frame": np.repeat(np.arange(3), 2), "time_s": np.repeat(np.arange(3) / 30.0, 2)}
    points, confidence = rng.uniform(50.0, 400.0, (6, 17, 2)), rng.uniform(0.2, 1.0, (6, 17))
    points[0, 3], confidence[0, 3] = np.nan, 0.0
    store = Store(tmp_path / "store")
    walk = annotated(store, "walk", places | {"pair17_confidence": confidence}, points)
    editor = Editor(open_viewer(Shelf(store, [walk.ref])), tmp_path / "out")
    drag = begin(editor, 1)
    drag(Dragged(1, WRIST, np.array([123.0, 45.0]), is_last=True))
    saved = read_annotation_csv(editor.save().read_bytes())
    points[2, WRIST] = 123.0, 45.0  # the second person is who has the larger number
    order = [1, 0, 3, 2, 5, 4]
    assert (saved.frame.tolist(), saved.person_id.tolist()) == ([0, 0, 1, 1, 2, 2], [4, 9] * 3)
    np.testing.assert_allclose(saved.keypoints_px, points[order], atol=5.1e-3)  # the file has 0.01 px
    np.testing.assert_allclose(saved.confidence, confidence[order], atol=5.1e-4)
    assert (saved.image_size_px, saved.rate_hz) == ({"walk": (640, 480)}, 30.0)


def test_a_reconstruction_is_located_by_who_was_seen_whoever_else_was_there(tmp_path: Path) -> None:
    camera = look_at_camera(
        np.array([0.2, 1.0, -0.3]), distance_m=5.0, yaw_rad=0.8, pitch_rad=0.3, focal_px=700.0, image_size_px=(640, 480)
    )
    rng = np.random.default_rng(6)
    body = rng.normal([0.2, 1.0, -0.3], 0.6, (4, 2, BODY22.num_joints, 3))
    px = np.full((4, 2, 17, 2), np.nan)
    px[:, :, LIMBS17] = camera.project(body[:, :, LIMBS22]).px
    store = Store(tmp_path / "store")
    # A is in no 2D pose, B is, and a third person, whom the reconstruction lacks.
    places = {"sequence_id": ["walk"] * 8, "frame": [0, 0, 1, 1, 2, 2, 3, 3], "person_id": [1, 7] * 4}
    points = np.stack([px[:, 1], rng.uniform(0.0, 400.0, (4, 17, 2))], axis=1).reshape(8, 17, 2)
    focal = {"partner_id": [7, 1] * 4, "focal_px": [700.0] * 8}
    seen = SequenceFootage(store, annotated(store, "walk", places | focal, points).ref, "walk")
    grid = Grid.of(np.repeat(np.arange(4), 2), np.array([0, 1] * 4))
    located = seen.locate_camera(body, grid, camera.camera_from_world_rotmat, 1.0)
    np.testing.assert_allclose(located.position_m, camera.position_m, atol=1e-4)
    point = np.full((1, 17, 2), np.nan)
    point[0, LIMBS17[0]] = 100.0
    alone = {"sequence_id": ["one"], "frame": [0], "person_id": [1], "partner_id": [0], "focal_px": [700.0]}
    seen = SequenceFootage(store, annotated(store, "one", alone, point).ref, "one")
    assert seen.locate_camera(body, grid, camera.camera_from_world_rotmat, 1.0) is None, "a point alone places nothing"


def test_a_single_image_has_the_film_of_its_own_artifact(tmp_path: Path) -> None:
    store = Store(tmp_path / "store")
    refs = []
    for name in ("one", "other"):
        places = {"sequence_id": [name] * 2, "frame": [0, 0], "person_id": [0, 1], "partner_id": [1, 0]}
        refs.append(annotated(store, name, places, np.full((2, 17, 2), 50.0)).ref)
    shelf = Shelf(store, refs)
    films = {ref: SimpleNamespace(image=lambda number, ref=ref: ref, trouble="") for ref in refs}
    shelf.film = films.__getitem__  # type: ignore[assignment]
    part = ViewedPartition("annotations", "images", tuple(refs))
    (item,) = shelf.items(part)
    scene = TABLE_VIEWS["annotations"].scene(shelf, part, item)
    shown = [flat.image() for frame in (0, 1) for flat in scene.images(frame) if flat.image is not None]
    assert shown == refs


def grey_film(path: Path, count: int) -> Path:
    """Write a film whose frames are grey, each by its number."""
    return write_film(path, [np.full((48, 64, 3), 6 * number, dtype=np.uint8) for number in range(count)])


def reader(path: Path, **told: object) -> FilmReader:
    return FilmReader(lambda: (SourceFile(path=str(path), sha256=""),), **told)  # type: ignore[arg-type]


def grey_of(film: FilmReader, number: int) -> float:
    image = film.image(number)
    assert image is not None, number
    return float(image.mean())


@pytest.fixture
def few_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a reader of film keep few images."""
    monkeypatch.setattr("flows.viewing.films._NUM_KEPT", 8)
    monkeypatch.setattr("flows.viewing.films._NUM_BEFORE", 4)


OF_FILM = {"num_given": 1, "num_networks": 0, "first_number": 0, "first_frame": 0, "is_constant_rate": True}


def test_an_image_of_a_film_is_that_of_its_frame_in_any_order(tmp_path: Path, few_are_kept: None) -> None:
    film = reader(grey_film(tmp_path / "grey.avi", 40))
    for number in (0, 1, 38, 36, 3, 39, 20, 21):
        assert grey_of(film, number) == pytest.approx(6 * number, abs=2.5)
    assert film.image(40) is None
    assert film.image(4) is not None, "after its end it is read again"


def test_a_shot_is_sought_at_its_begin(tmp_path: Path, few_are_kept: None, monkeypatch: pytest.MonkeyPatch) -> None:
    reads: list[tuple[int, int, float | None]] = []

    def read(files: tuple[SourceFile, ...], first: int, after_s: float | None, sought: int) -> Iterator[FilmFrame]:
        reads.append((first, sought, after_s))
        return read_film(files, first, after_s=after_s, sought=sought)

    monkeypatch.setattr("flows.viewing.films.read_film", read)
    path = grey_film(tmp_path / "grey.mp4", 40)
    times_s = open_film(path).times_s
    film = reader(path, first_frame=10, after_s=times_s[9])
    for number in (20, 35, 12):
        assert grey_of(film, number) == pytest.approx(6 * number, abs=3.0)
    assert reads == [(16, 10, times_s[9]), (31, 21, times_s[20]), (10, 10, times_s[9])]


def test_of_a_film_of_a_varying_rate_the_image_is_that_of_the_overlay(tmp_path: Path) -> None:
    rng, path = np.random.default_rng(8), grey_film(tmp_path / "grey.mp4", 40)
    durations = rng.choice([0.25, 0.5, 1.0, 3.0], 40) / 30.0
    path.write_bytes(with_durations(path.read_bytes(), durations.tolist()))
    footage, film = FilmImages(path, 30.0), reader(path, rate_hz=30.0)
    num_frames = int(30.0 * durations[:-1].sum())
    for number in (num_frames - 3, *range(num_frames), *rng.permutation(num_frames).tolist()):
        assert grey_of(film, number) == pytest.approx(footage(number).mean(), abs=2.5)
    assert film.image(num_frames + 10) is None


def test_a_film_that_has_changed_is_not_shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = grey_film(tmp_path / "grey.avi", 5)
    files = (("keys.csv", "0" * 64), (path.name, user_file_digest(path)))
    manifest = SimpleNamespace(parameters=OF_FILM, files=files)
    ingest = {"videos": [{"id": "grey", "path": str(path)}]}
    asked: list[Path] = []
    monkeypatch.setattr("flows.viewing.films.user_file_digest", lambda one: asked.append(one) or user_file_digest(one))
    film_there = find_film(manifest, ingest)  # type: ignore[arg-type]
    assert not asked, "whoever opens an item does not wait for all of its film"
    assert film_there.image(4) is not None
    assert (asked, film_there.trouble) == ([path], "")
    manifest.files = (files[0], (path.name, "1" * 64))
    for sections in (ingest, {}):
        film = find_film(manifest, sections)  # type: ignore[arg-type]
        assert film.image(0) is None
        assert film.trouble == "the film grey.avi of these 2D poses is missing, or has changed since it was read"


def test_tracks_follow_a_dragged_joint_and_are_saved(tmp_path: Path, open_viewer: OpenViewer) -> None:
    film = write_film(tmp_path / "walk.mp4", (painted(0, frame) for frame in range(20)))
    keys = write_keys(tmp_path / "keys.csv", [0, 8, 19])
    source = {"id": "walk", "path": str(film), "keys": str(keys)}
    store = Store(tmp_path / "store")
    (manifest,) = run(store, planned(videos=[source])).values()
    shown = open_viewer(Shelf(store, [manifest.ref], sections={"ingest": {"videos": [source]}}))
    editor = Editor(shown, tmp_path / "out")
    drag = begin(editor, 0)
    assert editor._next.visible
    editor.next_to_correct()
    assert shown.frame in shown.shelf.shot(manifest.ref).next_frames(20)
    shown.seek(13)
    before = [shown.scene.images(at)[0].points_px.copy() for at in range(20)]
    for share in (0.5, 1.0):
        drag(Dragged(1, WRIST, before[13][1, WRIST] + share * np.array([16.0, 6.0]), is_last=share == 1.0))
    assert shown.frame == 13
    after = [shown.scene.images(at)[0].points_px for at in range(20)]
    moved = np.linalg.norm(np.array(after) - before, axis=-1)
    assert moved[13, 1, WRIST] == pytest.approx(np.hypot(16.0, 6.0), abs=0.01)
    assert moved[[12, 14], 1, WRIST].min() > 3.0
    moved[:, 1, WRIST] = 0.0
    assert moved.max() < 1e-3
    with pytest.raises(InputError, match="chest is no keypoint of the layout 'coco17'"):
        drag(Dragged(1, PAIR17.index("chest"), before[13][1, WRIST], is_last=True))
    (saved,) = find_videos(FilmOptions(id="walk", path=film, keys=editor.save()))
    frames = saved.read()
    row = np.flatnonzero((frames.frame == 13) & (frames.person_id == 1))[0]
    joint = KEYPOINT_LAYOUTS["coco17"].keypoint_names.index("left_wrist")
    assert frames.status[row, joint] == KeypointStatus.ANNOTATED
    np.testing.assert_allclose(frames.keypoints_px[row, joint], after[13][1, WRIST], atol=0.01)


def test_a_video_beside_keypoints_is_their_film_where_it_has_their_size(tmp_path: Path) -> None:
    keys = write_keys(tmp_path / "dance.csv", [0, 1])
    grey_film(tmp_path / "dance.avi", 5)
    ingest = {"annotations": [{"id": "dance", "path": str(keys)}]}
    parameters = {"id": "dance", "video_size_px": [64, 48]}
    manifest = SimpleNamespace(parameters=parameters, files=())
    film = find_film(manifest, ingest)  # type: ignore[arg-type]
    assert isinstance(film, FilmReader)
    assert film.image(4) is not None
    parameters["video_size_px"] = [640, 480]
    assert find_film(manifest, ingest) is None  # type: ignore[arg-type]
    keys.unlink()
    assert find_film(manifest, ingest) is None, "who looks later may have moved it"  # type: ignore[arg-type]


def test_a_film_of_images_of_which_one_has_changed_is_not_shown(tmp_path: Path) -> None:
    paths = [tmp_path / f"{number}.png" for number in range(3)]
    for path in paths:
        cv2.imwrite(str(path), np.full((8, 8, 3), 90, dtype=np.uint8))
    files = tuple((path.name, user_file_digest(path)) for path in paths)
    ingest = {"videos": [{"id": "images", "path": str(tmp_path)}]}
    for last, is_shown in ((files[2], True), ((paths[2].name, "1" * 64), False)):
        manifest = SimpleNamespace(parameters=OF_FILM | {"num_given": 0}, files=(*files[:2], last))
        film = find_film(manifest, ingest)  # type: ignore[arg-type]
        assert (film.image(2) is not None) is is_shown
