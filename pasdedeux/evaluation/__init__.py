"""Evaluation: metrics, comparisons, figures and the report."""
