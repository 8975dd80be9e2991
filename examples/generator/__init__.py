"""Renders capture folders with ground truth: any mesh, board, camera and flashlight path. See make_capture.py."""
