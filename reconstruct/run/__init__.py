"""A run from photos to results.

Comes in: a Source and RunOptions.
Goes out: a run folder with everything that CONVENTIONS.md lists; resumable after each stage; with `batch`, many runs.
"""
