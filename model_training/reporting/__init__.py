"""Evaluations as pages for people: self-contained HTML without scripts."""
