"""Several views of one object on one board: calibrated together.

One idea: a view is a capture of one view as before, except that its camera comes from a fit to the boards of all views.
Afterwards the views are compared: they must see one object at one place, and read a board with two alike ends from the
same end. What does not agree is left out with a sentence; the others are used.

Comes in: a Capture, and for each of its sessions a PhotoStack with findings.
Goes out: CalibratedViews, in the frame of the board.
"""
