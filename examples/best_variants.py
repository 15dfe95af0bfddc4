"""Keep the variants of a study with the smallest contact drift: write a list of choices that rejects the others.

    python examples/best_variants.py duets --store store --share 0.5 --out curation.txt

`pasdedeux export variants:STUDY --curation curation.txt` and `Data(store, "curation.txt")` apply the list.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from pasdedeux.data import Data
from tasks.files.curation import content_of

arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
arguments.add_argument("study")
arguments.add_argument("--store", default="store")
arguments.add_argument("--share", type=float, default=0.5, help="share of the variants to keep")
arguments.add_argument("--out", type=Path, default=Path("curation.txt"))
options = arguments.parse_args()

data = Data(options.store)
figures = data.table(f"variant_quality:{options.study}", ["take_id", "variant_id", "contact_drift_m"])
drift_m = {
    f"{take}/{variant}": float(drift)
    for take, variant, drift in zip(*(figures[name] for name in figures.column_names), strict=True)
}
limit_m = float(np.nanquantile(list(drift_m.values()), options.share))
lines = [
    f"reject variants {clip.identity} {content_of(clip.positions_m)} drift of {1e3 * drift_m[clip.identity]:.2f} mm"
    for clip in data.variants(options.study)
    if drift_m[clip.identity] > limit_m
]
options.out.write_text("\n".join(lines) + "\n", encoding="utf-8")
kept = len(drift_m) - len(lines)
print(f"{options.out}: {kept} of {len(drift_m)} variants kept, {1e3 * limit_m:.2f} mm of drift at most")
