"""Reconstruction: motion of one or several people from 2D, by the projection database and a fit to the image."""
