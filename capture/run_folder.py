"""A run folder: everything a run leaves behind, written so that a kill at any moment loses nothing that was finished."""
