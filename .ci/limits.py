"""Limits that ruff has no rule for: lengths of functions and modules, sizes of files, one newline at their end.

python .ci/limits.py FILE...    says what is beyond a limit, one line each; exit code 1 where something is
"""

import ast
import sys
from pathlib import Path

FUNCTION_LINES = 60
MODULE_LINES = 400
FILE_BYTES = 500_000
PRODUCT = ("capture", "calibration", "reconstruct", "viewer", "shadowgraph")
LONG_MODULES = {"kernels.py": "numba inlines functions of one module only, and compiles them together"}


def long_functions(tree: ast.AST) -> list[tuple[ast.FunctionDef | ast.AsyncFunctionDef, int]]:
    """Functions of more lines than they may have, and how many they have: decorators do not count."""
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]
    lengths = [(node, (node.end_lineno or node.lineno) - node.lineno + 1) for node in functions]
    return [(node, lines) for node, lines in lengths if lines > FUNCTION_LINES]


def faults(path: Path) -> list[str]:
    """What is beyond a limit in a file, one sentence each."""
    content = path.read_bytes()
    found = [f"{path}: {len(content)} bytes, at most {FILE_BYTES}"] if len(content) > FILE_BYTES else []
    if b"\0" in content[:8192]:  # no text
        return found
    if content and (not content.endswith(b"\n") or content.endswith(b"\n\n")):
        found.append(f"{path}: must end with one newline")
    if path.suffix == ".py":
        found += [
            f"{path}:{node.lineno}: {node.name} has {lines} lines, at most {FUNCTION_LINES}"
            for node, lines in long_functions(ast.parse(content))
        ]
        lines = content.count(b"\n")
        is_product = any(parent.name in PRODUCT for parent in path.parents)
        if is_product and path.name not in LONG_MODULES and lines > MODULE_LINES:
            found.append(f"{path}: {lines} lines, at most {MODULE_LINES}")
    return found


def main() -> int:
    found = [fault for name in sys.argv[1:] for fault in faults(Path(name))]
    print("\n".join(found), end="\n" if found else "")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
