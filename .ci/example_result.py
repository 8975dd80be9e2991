"""Make the result that the studio's first page shows: the stage of a run of examples/spot, without the photos.

shadowgraph run examples/spot --preset draft --out RUN && python .ci/example_result.py RUN
"""

import sys
from pathlib import Path

from reconstruct.stored_run.stage_pack import stage_archive
from reconstruct.stored_run.stored_run import StoredRun
from viewer.stage.parts import facts_and_parts
from viewer.studio.library import EXAMPLE_RESULT


def main() -> None:
    """Write it for the run that is named."""
    run = Path(sys.argv[1])
    facts, parts = facts_and_parts(StoredRun(run))
    for name in facts["addresses"]["photos"].values():
        parts.pop(name)
    facts["addresses"]["photos"] = {}
    EXAMPLE_RESULT.write_bytes(stage_archive(run, facts, parts))


if __name__ == "__main__":
    main()
