"""The board: printed, or a blank sheet or card.

Comes in: photos of a board, or its description.
Goes out: its corners or edges, the camera's intrinsics, the camera's pose above the ground, and the board as a page to
print.
"""
