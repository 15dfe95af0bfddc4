"""A version of a dataset as one folder that any tool opens; `docs/datasets.md` describes its files."""

from flows.dataset_folder.reading import read_folder, rebuild_folder
from flows.dataset_folder.writing import write_folder

__all__ = ["read_folder", "rebuild_folder", "write_folder"]
