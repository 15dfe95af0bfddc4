"""Formats: readers and writers of motion and keypoint files; bytes or text in, values out, never a path."""
