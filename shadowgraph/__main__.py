"""`python -m shadowgraph`, or `python PATH/shadowgraph` from a checkout that is not installed."""

import sys
from pathlib import Path

if not __package__:  # started by its path: the checkout is where the other packages are
    sys.path[0] = str(Path(__file__).resolve().parents[1])

from shadowgraph.command import main

sys.exit(main())
