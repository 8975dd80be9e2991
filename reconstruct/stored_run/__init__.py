"""A run folder that may come from a stranger, read through one door.

Comes in: the path of a run folder: our own, a friend's, or one that somebody made to do harm.
Goes out: typed objects whose numbers are finite, in range and agree with each other; or one sentence, a UserError.

The one idea: nobody else opens a file of a run folder. Each file has one loader here or beside its writer
(calibration.json: calibration/calibration.py; the tensors: reconstruct/fields.py and reconstruct/detail/file.py), and
each loader does the same five things in this order: it opens a regular file without following a link or waiting; it
compares what the header states with the file's size before memory is allocated; it checks types, shapes and counts;
it checks that numbers are finite and of a size that a scene has; it hands out objects that kernels can take as they
are. What must agree between files (units, pixels, the place of the mesh in the grid) is checked by StoredRun. Text
stays text: it is escaped where a page is made. tests/test_architecture.py refuses a reader of files anywhere else.
"""
