"""Pairs as JSON for editing, one file for both people; a study reads them as seeds (`seeds.files`)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

from flows.exports.export_format import Export, ExportFormat, FileNames, names_pairs, write_text
from pasdedeux.formats.pair_file import PairFile, write_pair_json
from tasks.seeds.files import pair_of_draw, pairs_of_seeds


def _write(export: Export, out: Path) -> Iterable[Path]:
    """Write a file for each pair, with every digit, its lineage and credits."""
    names = FileNames(out)
    return [write_text(names.path(name, suffix=".json"), write_pair_json(pair)) for name, pair in named_pairs(export)]


FORMAT = ExportFormat(_write, names_pairs, "seeds and single draws (draws@key#row)")


def named_pairs(export: Export) -> Iterator[tuple[str, PairFile]]:
    """Yield the pairs of seeds or of a draw, with their file names."""
    if export.reference.table == "seeds":
        for index, pair in pairs_of_seeds(export.store, export.text):
            if str(index) not in export.left_out:
                yield f"seed{index}", pair
    else:
        draw = pair_of_draw(export.store, export.text)
        yield f"draw-{draw.ref.key[:12]}-{draw.row}", draw.pair
