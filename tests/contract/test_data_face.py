"""A store's takes, variants, draws and contacts as objects, and as windows to train on."""

from __future__ import annotations

import io
import math
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from benchmarks import moving_picture
from flows.exports import export_reference
from pasdedeux.augmentation import UserContact
from pasdedeux.data import Data, PairDataset
from pasdedeux.errors import InputError
from pasdedeux.evaluation.motion_players import MAX_LINKS, links_of
from pasdedeux.skeletons import BODY22
from storage_schema import SchemaError, ShardRecord, Store, UnknownReference, open_table, record_latest
from tasks import augmentation
from tasks.augmentation import AugmentationParameters
from tasks.data import Clip
from tasks.rows.contacts import find_contact_rows
from tasks.stage import StageInputs
from tests.builders.browser import in_browser
from tests.builders.ingest_runs import planned, run
from tests.builders.pages import Page
from tests.builders.storage_rows import commit_rows
from tests.builders.toy_runs import ROOT

pytestmark = pytest.mark.usefixtures("own_cache")

HELD_OUT = "hug-001"


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Store:
    store = Store(tmp_path_factory.mktemp("store"))
    duets = [{"name": "waltz", "count": 3, "duration_s": 2}, {"name": "hug", "count": 1, "duration_s": 2}]
    shards = planned(rate_hz=15, duets=duets, held_out=[HELD_OUT])
    takes = [made for (_, name), made in run(store, [shard for shard in shards if shard.name == "take"]).items()]
    inputs = StageInputs({"poses": takes, "takes": takes}, seed=3)
    asked = AugmentationParameters(scales=(0.8, 1.2), persons=("A",), kinds=("uniform",))
    variants = [store.manifest(augmentation.run_shard(shard, store)) for shard in augmentation.plan(inputs, asked)]
    draws = [store.manifest(commit_rows(store, "draws", 7, stage="chains", partition="ic-seed0"))]
    made = {"ingest": takes, "augmentation": variants, "chains": draws}
    records = {stage: [ShardRecord.of(manifest, store) for manifest in found] for stage, found in made.items()}
    record_latest(store, "toy", "run-1", records)
    return store


def test_clips_say_joints_rate_and_unit_and_give_numpy_and_pandas(store: Store) -> None:
    take, *others = Data(store).takes("toy")
    assert len(others) == 3
    assert (take.joints, take.rate_hz, take.unit, take.up_axis) == (BODY22.joint_names, 15.0, "m", "Y")
    variant = Data(store.root).variants(f"toy/{take.name}")[0]
    assert variant.source is not None
    assert (variant.name, variant.source.name) == (f"{take.name}, A-uniform-0.80", take.name)
    assert repr(take) == f"Clip(name='{take.name}', source=None, verdict='{take.verdict}')"
    assert repr(variant) == f"Clip(name='{variant.name}', source={variant.source}, verdict='{variant.verdict}')"
    assert repr(Data(store).draws("toy")) == "Pairs(name='draws:toy')"
    assert np.asarray(variant).shape == np.asarray(take).shape == (30, 2, 22, 3)
    rows = variant.pandas()
    wrist = variant.positions_m[3, 1, BODY22.index("left_wrist")]
    np.testing.assert_array_equal(rows.loc[3, "B", "left_wrist"][["x_m", "y_m", "z_m"]], wrist)
    assert rows.loc[(3, "B"), "time_s"].tolist() == [3 / 15] * 22
    assert np.ptp(variant.positions_m[0, 0, :, 1]) < np.ptp(take.positions_m[0, 0, :, 1]), "person A is smaller"


def test_contacts_of_a_clip_are_the_rows_of_the_table_that_is_exported(store: Store, tmp_path: Path) -> None:
    export_reference(store, "contacts:toy", "csv", tmp_path)
    exported = pd.read_csv(tmp_path / "contacts.csv")
    variant = next(clip for clip in Data(store).variants("toy") if "waltz" in clip.name)
    assert variant.source is not None
    rows = exported[exported["take_id"] == variant.source.name]
    of_take, of_variant = rows["variant_id"].isna(), rows["variant_id"] == "A-uniform-0.80"
    for clip, table in ((variant.source, rows[of_take]), (variant, rows[of_variant])):
        found = clip.contacts.pandas()
        assert len(found) == len(table) > 20
        same = ["frame", "person", "bone", "share", "partner", "partner_bone", "distance_m", "gap_m", "weight"]
        pd.testing.assert_frame_equal(found[same], table[same].reset_index(drop=True))
        np.testing.assert_allclose(found[["point_x_m", "point_z_m"]], table[["point_m.x", "point_m.z"]], atol=1e-6)
    here = variant.contacts
    matrix = here.matrix(5, 9)
    at = ((here.frame == 6) & (here.person >= 0).all(axis=1)).nonzero()[0][0]
    pair = here.bone[at][np.argsort(here.person[at])]
    assert matrix[1, pair[0], pair[1]] > 0.0
    links = links_of(variant._contacts, variant.positions_m)
    assert links.shape[1] <= MAX_LINKS
    assert (np.isfinite(links).all(axis=(2, 3)).sum(axis=1) <= variant._contacts.is_held.sum(axis=1)).all()


def test_a_contact_that_the_study_states_for_variants_stands_in_them_and_not_in_the_take(store: Store) -> None:
    take = next(clip for clip in Data(store).takes("toy") if "waltz" in clip.name)
    hands = {"person_a": "A", "joint_a": "left_wrist", "person_b": "B", "joint_b": "right_ankle"}
    stated = UserContact(**hands, start_frame=0, stop_frame=30, weight=1.0)  # type: ignore[arg-type]
    asked = AugmentationParameters(scales=(1.1,), persons=("A",), kinds=("uniform",), contacts={take.name: (stated,)})
    (shard,) = augmentation.plan(StageInputs({"poses": [take.take], "takes": [take.take]}, seed=3), asked)
    ref = augmentation.run_shard(shard, store)
    motion = store.read(ref, "variants")["body22_m"].reshape(30, 2, 22, 3)
    for contacts, is_there in ((find_contact_rows(store, ref, motion, "x"), True), (take.contacts, False)):
        rows = contacts.pandas()
        is_stated = (rows["bone"] == "left_wrist") & (rows["partner_bone"] == "right_ankle")
        assert set(range(30)).issubset(rows["frame"][is_stated]) is is_there


def test_clips_and_draws_show_themselves_with_the_player_of_the_report(store: Store, tmp_path: Path) -> None:
    data = Data(store)
    draws = data.draws("toy")
    assert len(draws) == len(draws.pandas()) // 34 == 7
    some = data.pairs("draws:toy", count=3)
    np.testing.assert_array_equal(some.positions_m, draws.positions_m[some.rows])
    assert some.rows.tolist() == [0, 3, 6]
    (pair_m,) = data.pairs("draws:toy#4").positions_m
    np.testing.assert_array_equal(pair_m, draws.positions_m[4])
    for shown, panels in ((data.takes("toy")[0], 1), (data.variants("toy")[0], 2), (draws, 1)):
        frame = Page(f"<html>{shown._repr_html_()}</html>")
        assert (frame.problems, frame.outside) == ([], [])
        page = Page(frame.framed)
        assert (page.problems, page.outside, page.unnamed) == ([], [], [])
        assert [len(scene["panels"]) for scene in page.scenes] == [panels]
    answer = in_browser(frame.framed, "return document.querySelectorAll('canvas').length;", tmp_path)
    assert answer == {"found": 1, "errors": []}


@pytest.mark.usefixtures("forking")
def test_torch_loads_batches_with_workers(store: Store) -> None:
    from torch.utils.data import DataLoader

    windows = PairDataset("variants:toy", 10, store=store.root)
    plain, spread = (
        [batch["positions"] for batch in DataLoader(windows, batch_size=8, num_workers=num_workers)]  # type: ignore[arg-type]
        for num_workers in (0, 1)
    )
    assert [tuple(batch.shape) for batch in plain] == [(8, 10, 2, 22, 3)] * 2 + [(4, 10, 2, 22, 3)]
    assert all((alone == forked).all() for alone, forked in zip(plain, spread, strict=True))


def test_what_holds_no_windows_is_said(store: Store) -> None:
    with pytest.raises(InputError, match="'draws:toy' is not of variants or takes"):
        PairDataset("draws:toy", store=store.root)
    with pytest.raises(InputError, match="4 variants on the side train has 30 frames, fewer than the window of 60"):
        PairDataset("variants:toy", store=store.root)
    with pytest.raises(UnknownReference, match="study 'salsa' has not run"):
        Data(store).takes("salsa")


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("window", (0, -1, 2.5, "30", True, None, math.nan)),
        ("stride", (0, -5, 1.5, "5", True)),
        ("seed", (-1, 0.5, None)),
        ("split", ("dev", None, 3)),
        ("by", ("frame", None)),
    ],
)
def test_an_argument_that_is_not_allowed_is_named_and_nothing_else(
    store: Store, name: str, values: tuple[Any, ...]
) -> None:
    for value in values:
        with pytest.raises(InputError, match=f"^{name} is {re.escape(repr(value))}; it must be"):
            PairDataset("variants:toy", **{"window": 10, "store": store.root, name: value})
    assert len(PairDataset("variants:toy", np.int64(10), store=store.root, stride=np.int64(5))) == 20  # type: ignore[arg-type]


def test_every_face_names_the_argument_that_is_wrong(store: Store) -> None:
    data = Data(store)
    for count in (0, -3, 1.5):
        with pytest.raises(InputError, match=r"^count is "):
            data.pairs("draws:toy", count=count)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="'poses' has no pairs; tables that have some: draws"):
        data.pairs("poses:toy")
    contacts = data.takes("toy")[0].contacts
    for frames, name in (((-1, 5), "first"), ((5, 2), "stop"), ((0, 1.5), "stop")):
        with pytest.raises(InputError, match=f"^{name} is "):
            contacts.matrix(*frames)  # type: ignore[arg-type]
    for read in (data.table, lambda *args: open_table(args[0], store, columns=args[1])):
        with pytest.raises(SchemaError, match="columns are a list of names"):
            read("poses:toy", "pair17_m")


def test_the_lines_of_the_readme_run(
    store: Store, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (Path(__file__).parents[2] / "README.md").read_text(encoding="utf-8")
    (lines,) = (block.partition("```")[0] for block in text.split("```python\n")[1:])
    monkeypatch.setenv("PASDEDEUX_STORE", str(store.root))
    toy = (
        lines.replace('Data("store")', f'Data("{store.root}")')
        .replace("duets", "toy")
        .replace("window=30", f'window=10, store="{store.root}"')
    )
    exec(compile(toy, "README.md", "exec"), {})
    assert capsys.readouterr().out.count("A-uniform") >= 8


def test_the_moving_picture_is_small_whole_and_always_the_same(store: Store) -> None:
    variant = Data(store).variants("toy")[0]
    assert variant.source is not None
    clips = {"source": variant.source, "person A at 0.8 of the size": variant}
    drawn = moving_picture.clips_picture(clips)
    assert drawn == moving_picture.clips_picture(clips)
    image = Image.open(io.BytesIO(drawn))
    assert (image.format, image.width, image.n_frames) == ("WEBP", 720, 30)  # type: ignore[attr-defined]
    pixels = np.asarray(image.convert("RGB")).astype(int)
    is_drawn = np.abs(pixels - pixels[0, 0]).max(axis=-1) > 60
    for edge in (is_drawn[0], is_drawn[-1], is_drawn[:32, 0], is_drawn[:32, -1]):
        assert not edge.any(), "titles and people are whole"
    for half in (pixels[:, :360], pixels[:, 360:]):
        is_green = (half[..., 1] > half[..., 0] + 60) & (half[..., 1] > half[..., 2] + 30)
        assert is_green.sum() > 10, "contacts are marked"


def test_the_moving_picture_is_drawn_of_the_variants_that_are_named(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    take = Data(store).takes("toy")[0].name
    drawn: dict[str, Clip] = {}
    monkeypatch.setattr(moving_picture, "clips_picture", lambda clips: drawn.update(clips) or b"drawn")
    words = ["--store", str(store.root), "--take", f"toy/{take}", "--out", str(tmp_path / "x.webp")]
    monkeypatch.setattr(sys, "argv", ["", *words, "--variants", "A-uniform-1.20", "A-uniform-0.80"])
    moving_picture.main()
    assert {title: clip.name for title, clip in drawn.items()} == {
        "source": take,
        "person A at 1.20 of the size": f"{take}, A-uniform-1.20",
        "person A at 0.80 of the size": f"{take}, A-uniform-0.80",
    }
    assert (tmp_path / "x.webp").read_bytes() == b"drawn"


def test_a_folder_called_tasks_that_hides_ours_is_named(tmp_path: Path) -> None:
    (tmp_path / "tasks").mkdir()
    (tmp_path / "tasks" / "__init__.py").touch()
    script = "import sys; sys.path.insert(0, '.'); from pasdedeux.data import Data"
    found = subprocess.run(
        [sys.executable, "-c", script],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert found.stderr.splitlines()[-1] == (
        f"ImportError: the folder {tmp_path / 'tasks'} hides `tasks` of pasdedeux: rename it, or start Python elsewhere"
    )


def test_the_example_chooses_the_best_variants_and_its_list_is_obeyed(store: Store, tmp_path: Path) -> None:
    script = str(ROOT / "examples" / "best_variants.py")
    command = [sys.executable, script, "toy", "--store", str(store.root)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    kept = {clip.name for clip in Data(store, tmp_path / "curation.txt").variants("toy")}
    assert f"curation.txt: {len(kept)} of 8 variants kept" in done.stdout
    figures = drift_of_variants(store)
    left_out = [drift for name, drift in figures.items() if name not in kept]
    assert left_out
    assert np.nanmax([figures[name] for name in kept]) <= min(left_out)


def drift_of_variants(store: Store) -> dict[str, float]:
    """Return the contact drift of each variant by its name; NaN where nothing is in contact."""
    rows = open_table("variant_quality:toy", store, columns=["take_id", "variant_id", "contact_drift_m"])
    columns = zip(*(rows[name] for name in rows.column_names), strict=True)
    return {f"{take}, {name}": float(drift) for take, name, drift in columns}
