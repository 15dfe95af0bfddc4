"""Film of the user, annotated in every frame."""
