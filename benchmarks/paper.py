"""The figures that the paper prints, to stand beside ours [ShadowNeuS, CVPR 2023; labels of its tables in brackets].

Its scenes are not ours where a table does not say so: such figures are a neighbourhood, not a race.
"""

DEEPSHADOW = {  # nMZE [tab:deepshadow_nmze], normal error in degrees and depth L1 [tab:deepshadow_quant]
    "cactus": (0.0392, 20.02, 0.0063),
    "rose": (0.0709, 18.35, 0.0202),
    "bread": (0.1001, 27.37, 0.0256),
    "sculptures": (0.0678, 23.19, 0.0199),
    "sine_surface": (0.0381, 7.04, 0.0036),
    "relief": (0.1427, 22.13, 0.0053),
}
DEEPSHADOW_OWN = {  # the DeepShadow column of the same tables
    "cactus": (0.1001, 20.79, 0.0091),
    "rose": (0.0760, 24.32, 0.0132),
    "bread": (0.1166, 22.44, 0.0634),
    "sculptures": (0.1779, 26.66, 0.0334),
    "sine_surface": (0.0952, 12.15, 0.0078),
    "relief": (0.1424, 19.19, 0.0067),
}
PHOTOS = {  # number of photos of the Chair: depth L1, normal error in degrees
    3: (0.1427, 28.03),
    5: (0.0216, 10.52),
    10: (0.0189, 8.88),
    20: (0.0127, 7.59),
    50: (0.0074, 7.01),
}
SUPERVISED = {  # shadows on object and ground of the Lego
    "full": (0.02955, 19.59),
    "background-only": (0.05827, 29.93),
    "foreground-only": (0.13569, 23.94),
}
ABLATIONS = {  # mean over its scenes of directional colour photos
    "full": (0.1341, 15.03),
    "intersection": (0.2569, 18.01),
    "boundary": (0.3552, 28.44),
}
OWN_SCENES = {  # means over its eight scenes, by a case of ours that has the same pictures and kind of light
    "bunny_point: shadow": (0.1870, 20.21),
    "spot_dir: rgb": (0.1341, 15.03),
}
ITERATIONS, HOURS = 150_000, 24.0  # on one RTX 2080Ti
