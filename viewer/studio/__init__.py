"""The studio: captures and runs of a folder in the browser, from photos to a model on the screen.

One idea: the folder is the truth. Captures, runs and what the studio keeps (`.studio/`: queue, files under way,
trash) are files that are written whole; the server holds nothing else, so it can be killed and started again, and
browsers only ask what is there. Work is done by other processes: runs by the queue of reconstruct/run, one at a time
and detached; checks by `shadowgraph check`; pictures and first looks by a helper process. Strangers' photos are
decoded there, never in the server.

Comes in: a folder, requests of its owner's browser, files from phones that were let in.
Goes out: pages, captures, jobs in the queue.
"""
