"""A run that measures what its page costs: python benchmarks/metered_run.py COSTS.json run CAPTURE --viewer on ...

Two parts, in CPU seconds by the process's own account, so that no second run is needed to compare with: what the run
spends on handing its state out (log lines, growing meshes), which it does with and without a viewer; and all of the
viewer's process, which does the rest.
"""

import json
import resource
import sys
import time
from pathlib import Path
from typing import Any

from sheet import cpu_of

# isort: split
import shadowgraph


def main() -> None:
    """The command, metered."""
    from reconstruct.run import solve_stage  # not by the viewer, whose process imports this file, too

    costs, arguments = Path(sys.argv[1]), sys.argv[2:]
    spent = {"handing_out_cpu_s": 0.0}
    reporter_of = solve_stage._reporter

    def metered(*given: Any) -> Any:
        report = reporter_of(*given)

        def tell(**what: Any) -> None:
            start = time.process_time()
            report(**what)
            spent["handing_out_cpu_s"] += time.process_time() - start

        return tell

    solve_stage._reporter = metered
    code = shadowgraph.main(arguments)
    spent |= {"run_cpu_s": cpu_of(resource.RUSAGE_SELF), "viewer_cpu_s": cpu_of(resource.RUSAGE_CHILDREN)}
    costs.write_text(json.dumps(spent))
    sys.exit(code)


if __name__ == "__main__":
    main()
