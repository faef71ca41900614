"""Errors that NumPy raises for a damaged NPY header.

NumPy parses the header as Python source text, so errors of the Python parser come through.
"""

import tokenize

#: Errors to catch around NumPy's header readers.
NPY_HEADER_ERRORS = (ValueError, TypeError, SyntaxError, EOFError, MemoryError, RecursionError, tokenize.TokenError)
