"""Rows of tables as the stages, the evaluation and exports read and write them."""
