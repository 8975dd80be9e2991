"""Shapes and types in signatures are checked while the suite runs; the numba kernels cannot carry such wrappers."""

from pathlib import Path

from jaxtyping import install_import_hook

ROOT = Path(__file__).parent.parent
KERNELS = ("kernels", "block_kernels", "levelset", "carve", "height_kernels", "mask_kernels")
COMPILED = {f"reconstruct.{name}" for name in KERNELS}
CHECKED = [
    f"{package}.{path.stem}"
    for package in ("capture", "calibration", "reconstruct")
    for path in sorted((ROOT / package).glob("*.py"))
    if f"{package}.{path.stem}" not in COMPILED and path.stem != "__init__"
]

install_import_hook(CHECKED, "beartype.beartype")
