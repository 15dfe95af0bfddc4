"""Plausibility: joint limits and capsules: which poses a body can take."""
