"""The studio over HTTP: its gate, its addresses, the listeners for the owner and for phones, and their pages in web/.

Comes in: requests, none of which is trusted.
Goes out: answers, each with a policy that loads nothing from elsewhere; calls of the Studio.
"""
