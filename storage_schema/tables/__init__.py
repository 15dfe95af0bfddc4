"""Every table of the project, by name: those that the modules of this folder define, in their order."""

from __future__ import annotations

from storage_schema.columns import Table
from storage_schema.tables import capture, lifted, products, reconstruction, sampling

__all__ = ["TABLES"]

TABLES: dict[str, Table] = {
    table.name: table
    for module in (capture, sampling, lifted, reconstruction, products)
    for table in vars(module).values()
    if isinstance(table, Table)
}
