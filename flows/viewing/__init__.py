"""The local viewer: what a store holds, seen in a browser; what a person decides there is kept in files beside it.

A kind of rows that can be looked at is one function and one line in `KINDS` of `kinds.py`.
"""
