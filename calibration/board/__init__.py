"""The printed board.

Comes in: photos of a board, or its description.
Goes out: its corners, the camera's intrinsics, the camera's pose above the ground, and the board as a page to print.
"""
