"""A run from photos to results.

Comes in: a capture folder and RunOptions.
Goes out: a run folder with everything that CONVENTIONS.md lists; resumable, checked, many at a time with `batch`.
"""
