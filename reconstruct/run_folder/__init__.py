"""The folder that a run fills.

Comes in: stages and what they write.
Goes out: files that are whole or absent, a log with cost and time left, a lock against a second process, and what
    visitors of the page ask for.
"""
