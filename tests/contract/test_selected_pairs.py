"""Selected pairs name the draws and grown pairs that they are, weigh what is independent, and go out as a table."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flows.exports import export_selection
from pasdedeux.errors import InputError
from pasdedeux.sampling.seeds import seed_quality
from pasdedeux.sampling.selection import MIN_LOG_PRIOR
from storage_schema import TABLES, ShardRecord, open_table, record_latest
from tasks.priors import read_limits
from tasks.rows.selection import select_pairs
from tests.builders.sampling_store import QUICK, run_chains, with_seeds
from tests.builders.storage_rows import having


def test_selected_pairs_are_what_they_are_said_to_be_weigh_what_is_independent_and_go_out_as_a_table(
    inputs: Any, tmp_path: Path
) -> None:
    store, tables = inputs
    given = with_seeds(store, tables, num_seeds=1, num_grown=12)
    made = run_chains(store, given, densities=("ic", "prior_only"), starts="seeds")
    stages = {"seeds": [*given.of("seeds")], "chains": made}
    shards = {name: [ShardRecord.of(manifest, store) for manifest in of] for name, of in stages.items()}
    record_latest(store, "mine", "run", shards)
    found = select_pairs(store, tuple(manifest.ref for of in stages.values() for manifest in of), 1000)
    rows = found.columns
    assert (found.num_draws, found.num_grown) == (2 * QUICK["num_draws"], 12)
    assert set(rows["density"]) == {"ic", None}
    for reference, pair in zip(rows["reference"], rows["pair17_m"], strict=True):
        np.testing.assert_array_equal(open_table(reference, store)["pair17_m"][0], pair)
    info = [store.read(manifest.ref, "chain_info") for manifest in having("chain_info", made)]
    sizes = [size for table in info if table["density"][0] == "ic" for size in table["ess_min"]]
    share = np.clip(np.nan_to_num(sizes, nan=1.0), 1.0, QUICK["num_draws"]) / QUICK["num_draws"]
    num_drawn = np.zeros(len(share))
    for manifest in having("draws", made):
        table = store.read(manifest.ref, "draws")
        if table["density"][0] == "ic":
            num_drawn += [np.sum(table["log_prior"][table["chain"] == at] >= MIN_LOG_PRIOR) for at in range(len(share))]
    (grown,) = (manifest for manifest in stages["seeds"] if manifest.name == "grown")
    table = store.read(grown.ref, "seeds")
    limits = read_limits(store, tuple(manifest.ref for manifest in stages["seeds"]))
    is_plausible = table["log_prior"] >= MIN_LOG_PRIOR
    num_grown = int(np.sum(is_plausible & seed_quality(table["pair17_m"], limits).is_possible))
    assert 0 < num_drawn.sum() <= found.num_draws
    assert 0 < num_grown <= found.num_grown
    assert found.num_plausible == num_drawn.sum() + num_grown
    # No grown pair repeats another here.
    np.testing.assert_allclose(found.num_independent, np.dot(share, num_drawn) + num_grown)
    np.testing.assert_allclose(rows["weight"].sum(), found.num_independent)
    (path, _), words = export_selection(store, "draws:mine", "npz", tmp_path, count=4)
    with np.load(path) as arrays:
        for column in TABLES["selected_pairs"].columns:
            assert column.name in arrays
            assert not column.unit or str(arrays[f"{column.name}_unit"]) == column.unit
        assert arrays["pair17_m"].shape == (4, 2, 17, 3)
        assert np.isnan(arrays["distance_m"][0])
    assert words.startswith("4 pairs, at least 2 cm from each other, of 16 draws and 12 grown or filled pairs, ")
    for text, form, said in (("draws:mine/ic-seed0", "npz", "all of a study"), ("draws:mine", "json", "cannot be")):
        with pytest.raises(InputError, match=said):
            export_selection(store, text, form, tmp_path, count=4)
