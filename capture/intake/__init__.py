"""Photos that arrive: in pieces over a network, in an archive, or dropped by hand.

Comes in: names, sizes and bytes that strangers send.
Goes out: whole files with safe names in a capture folder, each once; a sentence for what is not taken.
"""
