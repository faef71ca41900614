"""Checks of the compiled code: which instructions it has, whether all compilers' builds answer alike, what sanitizers say."""
