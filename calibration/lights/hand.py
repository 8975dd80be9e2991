"""Where a hand holds a flashlight: the one range that searches, priors and verdicts share, millimetres.

Lights are looked for in photos whose ground a printed board, a sheet or a card measures, so the world is in mm there.
A camera may stand 150 mm from a coin or a metre from a chair: the arm that holds the light is as long as ever.
"""

import numpy as np

# From the thing to the light. Nearer than NEAREST, hand and phone hide the thing from the camera; a person who leans
# in over a table reaches 750 mm (arms of adults: 600 to 800 mm), and with one step back twice as far.
NEAREST, FARTHEST = 200.0, 1500.0
USUAL = float(np.sqrt(NEAREST * FARTHEST))  # the middle of that range, in logarithms
DISTANCES = tuple(np.geomspace(NEAREST, FARTHEST, 7))  # of a search: 1.4 times as far each, as its places lie aside
LOWEST = 40.0  # above the table: half the width of a phone or of a hand around a torch
AIM = 180.0  # one sigma of a beam beside where all aim: 20 degrees at USUAL
AIM_MEAN = 300.0  # one sigma of where all aim, beside the photo's middle
