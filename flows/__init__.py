"""Orchestration: studies, plans, the flows that run them, and the command line."""
