"""Rigs of motion files: layout, length unit and up axis, and their motion on the working skeletons."""
