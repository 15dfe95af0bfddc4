"""Film of the user's own, annotated in every frame."""
