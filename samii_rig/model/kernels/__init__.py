"""The transfer matrices compiled: what is here is compiled together, and nothing else is.

`respond` is what Python calls; `lanes` is the arithmetic that all of them are written in. Whatever
changes in a file of this room makes numba compile them anew.
"""
