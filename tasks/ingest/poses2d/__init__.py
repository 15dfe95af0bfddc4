"""2D poses of the user."""
