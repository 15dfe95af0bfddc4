"""Writes the description of a dataset's folder: card, Croissant metadata, splits, skeletons, licences, record, page."""

from __future__ import annotations

import json
import re
import shutil
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import yaml

from flows.dataset_folder.contents import Contents
from flows.dataset_folder.croissant import ABOUT, croissant
from flows.dataset_folder.layout import RECORD, SPLITS_FILE, FolderFile
from flows.exports.credits import write_credits
from flows.finished_builds import portable_files
from flows.records import ENVIRONMENT_FILE
from flows.templates import fill_template
from pasdedeux.plain_text import counted
from pasdedeux.skeletons import WORKING_SKELETONS
from pasdedeux.spread import evenly_spread
from storage_schema import TABLES, Dataset, Manifest, Store
from storage_schema.arrow import ColumnKind, column_kind, value_type
from storage_schema.columns import Column
from storage_schema.datasets import DATASET_FILE
from storage_schema.durable import make_folder, write_file
from storage_schema.keys import json_file
from storage_schema.runs import STUDY_FILE
from tasks.data import Clip, player_page
from tasks.rows.sides import SPLITS
from tasks.rows.takes import take_of
from tasks.stage.facts import TakeFacts

ARTIFACTS_FILE, PAGE = "artifacts.json", "index.html"
_MAX_PLAYERS = 12
_HUB_LICENCES = {"apache-2.0", "mit", "cc0-1.0", "cc-by-4.0", "cc-by-sa-4.0", "cc-by-nc-4.0", "cc-by-nc-sa-4.0"}
"""Ids of licences that a card names directly; others are linked."""
_SIZES = ((10**3, "n<1K"), (10**4, "1K<n<10K"), (10**5, "10K<n<100K"), (10**6, "100K<n<1M"), (10**7, "1M<n<10M"))


def write_description(
    store: Store, contents: Contents, files: Mapping[str, FolderFile], stats: Mapping[str, Any], folder: Path
) -> None:
    """Write the description of the data files of a folder.

    Args:
        store: The store that they come from.
        contents: Their contents.
        files: The data files, by their names in the folder.
        stats: The content of `stats.json`.
        folder: The folder.
    """
    dataset = contents.dataset
    columns = ["clip_id", "take_id", "variant_id", "split", "verdict", "num_frames"]
    parts = sorted(folder.glob("data/clips/*"))
    clips = [clip for part in parts for clip in pq.read_table(part, columns=columns).to_pylist()]
    clips.sort(key=lambda clip: (SPLITS.index(clip["split"]), clip["take_id"], clip["variant_id"] or ""))
    splits = _splits(contents, clips)
    counts = ", ".join(f"{counted(splits['num_clips'][split], 'clip')} to {split}" for split in splits["num_clips"])
    what = (
        dataset.note
        if dataset.note and not dataset.note.startswith("run ")
        else f"Motion of people in contact: {counts}."
    )
    texts: dict[str, bytes] = {
        "stats.json": json_file(stats),
        SPLITS_FILE: json_file(splits),
        "skeletons.json": json_file(
            {name: {"joint_names": s.joint_names, "parents": s.parents} for name, s in WORKING_SKELETONS.items()}
        ),
        "croissant.json": json_file(croissant(dataset, what, files)),
        "README.md": _card(contents, files, what, splits, clips).encode(),
        PAGE: player_page(dataset.label, _pictures(store, contents, clips), _lines(contents, what, clips)).encode(),
        **_licences(dataset),
        **{f"{RECORD}/{name}": data for name, data in _record(contents).items()},
    }
    for name, data in texts.items():
        make_folder((folder / name).parent)
        write_file(folder / name, data)
    for manifest in contents.manifests:
        for name, entry in manifest.attachments.items():
            target = folder / attachment_name(manifest, name)
            make_folder(target.parent)
            shutil.copyfile(store.data_file(manifest.ref, name, entry), target)
    write_credits(dataset.sources, dataset.refs, dataset.label, folder)


def attachment_name(manifest: Manifest, name: str) -> str:
    """Return the path in a folder of an artifact's attachment, such as a report."""
    return f"{RECORD}/files/{manifest.ref.stage}-{manifest.ref.content_digest[:16]}/{name}"


def _splits(contents: Contents, clips: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the content of `splits.json`."""
    there = [split for split in SPLITS if any(clip["split"] == split for clip in clips)]
    by_split = {split: [clip for clip in clips if clip["split"] == split] for split in there}
    return {
        "by": "take",
        "takes": {name: asdict(side) for name, side in contents.sides.items()},
        "num_clips": {split: len(in_split) for split, in_split in by_split.items()},
        "num_frames": {split: sum(clip["num_frames"] for clip in in_split) for split, in_split in by_split.items()},
    }


def _card(
    contents: Contents,
    files: Mapping[str, FolderFile],
    what: str,
    splits: Mapping[str, Any],
    clips: list[dict[str, Any]],
) -> str:
    """Return the card: a head for the Hub and the library `datasets`, then text for people."""
    dataset = contents.dataset
    tables: dict[str, dict[str, list[FolderFile]]] = {}
    for name, file in files.items():
        tables.setdefault(name.split("/")[1], {}).setdefault(Path(name).name.split("-")[0], []).append(file)
    default = next(name for name in ("variants", "poses", "clips", *tables) if name in tables)
    order = sorted(tables, key=lambda name: (name != default, name))
    rows = {name: sum(file.rows for in_split in tables[name].values() for file in in_split) for name in order}
    licences = {source.licence for source in dataset.sources}
    known = next(iter(licences)).lower() if len(licences) == 1 else ""
    other = {"license_name": "see-licenses", "license_link": "CREDITS.txt"}
    head = {
        "pretty_name": dataset.label,
        "license": known if known in _HUB_LICENCES else "other",
        **({} if known in _HUB_LICENCES else other),
        "task_categories": ["other"],
        "tags": ["human-motion", "motion-capture", "interaction", "contact", "3d-pose", "pasdedeux"],
        "size_categories": [next((name for size, name in _SIZES if rows[default] < size), "10M<n<100M")],
        "configs": [
            {
                "config_name": table,
                **({"default": True} if table == default else {}),
                "data_files": [
                    {"split": s, "path": f"data/{table}/{s}-*.parquet"} for s in SPLITS if s in tables[table]
                ],
            }
            for table in order
        ],
        "dataset_info": [_info(table, tables[table]) for table in order],
    }
    takes = Counter(side.split for side in contents.sides.values())
    num_clips, num_frames = splits["num_clips"], splits["num_frames"]
    return fill_template(
        "dataset_card.md",
        head=yaml.safe_dump(head, sort_keys=False, allow_unicode=True),
        dataset=dataset,
        description=what,
        code_version=contents.manifests[0].code_version,
        splits={s: {"takes": takes[s], "clips": num_clips[s], "frames": f"{num_frames[s]:,}"} for s in num_clips},
        tables=rows,
        meaning={name: TABLES[name].meaning for name in rows},
        default=default,
        first_split=next(split for split in SPLITS if split in tables[default]),
        verdicts=dict(sorted(Counter(clip["verdict"] for clip in clips).items())),
        left_out=contents.left_out,
        limitations=[*ABOUT["dataLimitations"], *ABOUT["dataBiases"]],
    )


def _info(table: str, files: Mapping[str, list[FolderFile]]) -> dict[str, Any]:
    """Return the features and sizes of a table in the form of the library `datasets`."""
    sizes = {split: sum(file.bytes for file in files[split]) for split in SPLITS if split in files}
    return {
        "config_name": table,
        "features": [_feature(column) for column in TABLES[table].columns],
        "splits": [
            {"name": split, "num_bytes": size, "num_examples": sum(file.rows for file in files[split])}
            for split, size in sizes.items()
        ],
        "download_size": sum(sizes.values()),
        "dataset_size": sum(sizes.values()),
    }


def _feature(column: Column) -> dict[str, Any]:
    kind = str(value_type(column))
    kind = {"float": "float32", "double": "float64"}.get(kind, kind)
    if column_kind(column) in (ColumnKind.FIXED, ColumnKind.VARYING, ColumnKind.TEXT_LIST):
        length = {"length": column.type.list_size} if column_kind(column) is ColumnKind.FIXED else {}
        return {"name": column.name, "list": kind, **length}
    return {"name": column.name, "dtype": kind}


def _licences(dataset: Dataset) -> dict[str, bytes]:
    """Return the licences of the sources as files: the full text of this program's, the stated words of others."""
    licences = {}
    for licence in dict.fromkeys(source.licence for source in dataset.sources):
        name = licence if re.fullmatch(r"[A-Za-z0-9.+-]{1,40}", licence) else f"LicenseRef-{_plain(licence)}"
        of = "".join(f"{source.name}\n  {source.credit}\n" for source in dataset.sources if source.licence == licence)
        text = (_own_licence() if licence == "Apache-2.0" else "") or f"{licence}\n"
        licences[f"LICENSES/{name}.txt"] = f"{text}\nLicence of:\n\n{of}".encode()
    return licences


def _plain(text: str) -> str:
    return "-".join(re.findall("[A-Za-z0-9]+", text)).lower()[:60] or "unnamed"


def _own_licence() -> str:
    """Return the text of this program's licence, Apache-2.0; empty if the program is not installed."""
    try:
        return distribution("pasdedeux").read_text("licenses/LICENSE") or ""
    except PackageNotFoundError:
        return ""


def _record(contents: Contents) -> dict[str, bytes]:
    """Return the files for building the dataset again: study, environment, list of artifacts, manifests."""
    dataset = contents.dataset
    files = portable_files(dataset.path)
    there = {name: files[name] for name in (STUDY_FILE, ENVIRONMENT_FILE) if name in files}
    artifacts = {"artifacts": [json.loads(manifest.to_json()) for manifest in contents.manifests]}
    return there | {DATASET_FILE: dataset.to_json(), ARTIFACTS_FILE: json_file(artifacts)}


def _lines(contents: Contents, what: str, clips: list[dict[str, Any]]) -> list[str]:
    """Return the sentences of the page."""
    verdicts = Counter(clip["verdict"] for clip in clips)
    return [
        what,
        "Verdicts: " + ", ".join(f"{verdict} {count:,}" for verdict, count in sorted(verdicts.items())) + ".",
        *(f"From {source.name}: {source.licence}. {source.credit}" for source in contents.dataset.sources),
        f"Some of the {len(clips):,} clips, evenly spread, each beside its take; contacts are green.",
    ]


def _pictures(store: Store, contents: Contents, clips: list[dict[str, Any]]) -> list[Any]:
    """Return players of some variants, evenly spread, or of takes if there are no variants."""
    takes = {TakeFacts.of(manifest).take_id: manifest for manifest in contents.with_table("poses")}
    batches = {group.clip: group.ref for group in contents.groups if group.table == "variants"}
    pictures = []
    shown = [clip for clip in clips if clip["variant_id"] is not None] or clips  # with their takes
    for clip in (shown[at] for at in evenly_spread(len(shown), _MAX_PLAYERS)):
        source = Clip(clip["take_id"], takes[clip["take_id"]], store)
        if clip["variant_id"] is not None:
            manifest = store.manifest(batches[clip["clip_id"]])
            names = store.read(manifest.ref, "variant_quality", columns=["variant_id"])["variant_id"]
            name, index = f"{clip['take_id']}, {clip['variant_id']}", list(names).index(clip["variant_id"])
            take = store.manifest(take_of(store, manifest.ref))
            source = Clip(name, take, store, Clip(clip["take_id"], take, store), manifest, index, clip["verdict"])
        pictures.append(source.picture)
    return pictures
