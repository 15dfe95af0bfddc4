"""Choreography: built-in duets, closed-form two-person motions with known contacts."""
