"""Benchmarks and measurement scripts; part of a checkout, not of an installation.

`pasdedeux bench` runs the benchmarks of `registry`.  `families`, `film_figures`, `camera_figures` and `check_faults`
print figures of the documentation; `film_check` and `blender_check` run other programs and need environments of their
own.
"""
