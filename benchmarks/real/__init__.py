"""Figures on recordings and of what is done with real maps."""
