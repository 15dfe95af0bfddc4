"""Figures that are columns of tables; `python -m tasks.rows.figures` writes them to the file that the tables read.

The science declares figures and knows no tables; data on disk can be read without the science.
"""

from __future__ import annotations

import json
from pathlib import Path

from pasdedeux.augmentation import quality
from pasdedeux.plausibility import capture
from pasdedeux.sampling import diagnostics

COLUMNS_PATH = Path(__file__).parents[2] / "storage_schema" / "tables" / "figures.jsonl"

_FIGURES = {
    "variant_quality": quality.FIGURES,
    "variant_frames": quality.FRAME_FIGURES,
    "take_quality": capture.FIGURES,
    "chain_info": diagnostics.FIGURES,
}
_TYPES = {"int": "int32", "float": "float64", "str": "string"}


def figure_columns() -> str:
    """Return the columns of all figures, a line of JSON each."""
    return "".join(
        json.dumps([table, figure.name, _TYPES[figure.kind], figure.meaning, figure.unit, figure.is_nullable]) + "\n"
        for table, figures in _FIGURES.items()
        for figure in figures.values()
    )


def main() -> None:
    """Write the columns of figures, then the data dictionary."""
    COLUMNS_PATH.write_text(figure_columns(), encoding="utf-8")
    from storage_schema import dictionary  # reads the columns when it is imported

    dictionary.main()


if __name__ == "__main__":
    main()
