"""The local viewer: what a store holds, seen in a browser; what a person decides there is kept in files beside it.

To show another table, add a function and a line in `KINDS` of `kinds.py`.
"""
