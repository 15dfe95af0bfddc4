"""Formats: readers and writers of motion and keypoint files; bytes or text in, values out, never a path.

What is mangled is refused with a FormatError: one sentence that names the line, the frame or the entry, says what is
wrong and what is allowed.
"""
