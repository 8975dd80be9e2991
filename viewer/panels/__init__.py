"""Tabs of the page.

Comes in: a finished or growing run, and what the visitor does.
Goes out: one panel for each purpose.
"""
