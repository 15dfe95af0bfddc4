"""Takes: motion of people from files, and built-in duets."""
