"""Runs as pages that people read: self-contained HTML, without scripts."""
