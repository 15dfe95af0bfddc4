"""Benchmarks and measurement scripts; part of a checkout, not of an installation.

`pasdedeux bench` runs what `registry` lists.  `families` and `film_figures` print the figures of docs/findings.md;
`film_check` and `blender_check` run other programs and need environments of their own.
"""
