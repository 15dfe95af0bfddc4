"""Virtual cameras that see takes."""
