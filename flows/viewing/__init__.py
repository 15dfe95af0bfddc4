"""The local viewer: what a store holds, seen in a browser; what a person decides there is kept in files beside it.

To show another table, add a function and a line in `TABLE_VIEWS` of `table_views.py`.
"""
