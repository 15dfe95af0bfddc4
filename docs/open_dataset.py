"""Open a dataset's folder with readers that are not part of this program.

pip install datasets mlcroissant polars pandas pyarrow duckdb
python open_dataset.py FOLDER
"""

import os
import sys
from pathlib import Path

os.environ["HF_HUB_OFFLINE"] = os.environ["HF_DATASETS_OFFLINE"] = "1"

import datasets
import duckdb
import mlcroissant
import pandas
import polars

folder = Path(sys.argv[1])
tables = sorted(path.name for path in (folder / "data").iterdir())
rows = {}
for table in tables:
    files = str(folder / "data" / table / "*.parquet")
    rows[table] = {
        "pandas": len(pandas.concat(map(pandas.read_parquet, sorted((folder / "data" / table).iterdir())))),
        "polars": polars.scan_parquet(files).select(polars.len()).collect().item(),
        "duckdb": duckdb.sql(f"select count(*) from '{files}'").fetchall()[0][0],
    }
    streams = datasets.load_dataset(str(folder), table, streaming=True)
    rows[table]["datasets"] = sum(sum(1 for _ in stream) for stream in streams.values())
described = mlcroissant.Dataset(folder / "croissant.json")
for record_set in described.metadata.record_sets:
    table = record_set.id.removesuffix("-rows")
    rows[table]["mlcroissant"] = sum(1 for _ in described.records(record_set.id))
for table, counts in rows.items():
    assert len(set(counts.values())) == 1, f"{table}: readers differ: {counts}"
    sys.stdout.write(f"{table}: {counts['pandas']:,} rows by {', '.join(counts)}\n")
