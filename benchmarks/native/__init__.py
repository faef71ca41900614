"""Checks of the compiled code: its instructions, equal answers of all compilers' builds, and sanitizer reports."""
