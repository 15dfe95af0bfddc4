"""2D poses of the user's own."""
