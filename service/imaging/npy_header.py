"""NumPy reads the header of an NPY as Python text, and what it raises over damaged ones is the parser's own."""

import tokenize

NPY_HEADER_ERRORS = (ValueError, TypeError, SyntaxError, EOFError, MemoryError, RecursionError, tokenize.TokenError)
