"""Formats: readers and writers of motion and keypoint files; bytes or text in, values out, never a path.

A damaged file raises a FormatError: one sentence that names the line, the frame or the entry, the fault, and the
allowed form.
"""
