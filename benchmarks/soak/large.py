"""Many large photos on a small machine: does the run finish under a limit of memory, and was its need predicted?

    python benchmarks/soak/large.py [--photos 300] [--megapixels 12] [--preset draft] [--limit-gb 8] [--table FILE]

The photos are those of examples/spot, enlarged, with fresh noise in each so that no two files are alike; those of the
board are enlarged alike. The limit is the kernel's on the private memory of the process (RLIMIT_DATA). Writes a
Markdown table; exit code 1 where the run fails or the prediction is off by more than a fifth.
"""

import argparse
import json
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np
import psutil

ROOT = Path(__file__).parents[2]
SPOT = ROOT / "examples" / "spot"
MOST_OFF = 0.2
POLL_S = 0.1
NOISE = 2.0  # of 255
QUALITY = 90  # JPEG


def make_capture(folder: Path, photos: int, megapixels: float) -> tuple[int, int]:
    """The example with so many photos of that size; its width and height."""
    cv2.setRNGSeed(1)
    size = (0, 0)
    for role in ("board", "photos"):
        (folder / role).mkdir(parents=True)
        originals = sorted((SPOT / role).iterdir())
        for number in range(photos if role == "photos" else len(originals)):
            original = originals[number % len(originals)]
            small = cv2.imread(str(original))
            scale = (megapixels * 1e6 / (small.shape[0] * small.shape[1])) ** 0.5
            size = (round(small.shape[1] * scale), round(small.shape[0] * scale))
            large = cv2.resize(small, size, interpolation=cv2.INTER_CUBIC)
            noise = cv2.randn(np.empty(large.shape, np.int16), 0, NOISE) if role == "photos" else 0
            noisy = np.clip(large + noise, 0, 255).astype(np.uint8)
            name = f"IMG_{number + 1:04d}.jpg" if role == "photos" else original.name
            cv2.imwrite(str(folder / role / name), noisy, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    if (SPOT / "session.toml").exists():
        shutil.copy(SPOT / "session.toml", folder)
    return size


def run_limited(capture: Path, out: Path, preset: str, limit: float) -> tuple[int, float, float]:
    """Exit code, seconds and largest resident memory, bytes, of a run under a limit in bytes."""

    def limit_memory() -> None:
        resource.setrlimit(resource.RLIMIT_DATA, (int(limit), int(limit)))

    words = [sys.executable, str(ROOT / "shadowgraph.py"), "run", str(capture), "--out", str(out)]
    words += ["--preset", preset, "--viewer", "off"]
    start, peak = time.monotonic(), 0
    process = subprocess.Popen(words, cwd=ROOT, preexec_fn=limit_memory)
    watched = psutil.Process(process.pid)
    while process.poll() is None:
        try:
            peak = max(peak, watched.memory_info().rss)
        except psutil.Error:
            break
        time.sleep(POLL_S)
    return process.wait(), time.monotonic() - start, peak


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photos", type=int, default=300)
    parser.add_argument("--megapixels", type=float, default=12.0)
    parser.add_argument("--preset", default="draft")
    parser.add_argument("--limit-gb", type=float, default=8.0)
    parser.add_argument("--table", type=Path)
    options = parser.parse_args()
    work = Path(tempfile.mkdtemp(prefix="large_"))
    width, height = make_capture(work / "capture", options.photos, options.megapixels)
    out = work / "run"
    code, seconds, peak = run_limited(work / "capture", out, options.preset, 1e9 * options.limit_gb)
    log = (out / "log.jsonl").read_text() if (out / "log.jsonl").exists() else ""
    said = re.search(r"about ([0-9.]+) GB of memory", log)
    predicted = 1e9 * float(said[1]) if said else float("nan")
    off = predicted / peak - 1
    stages = {}
    if (out / "report.json").exists():
        stages = json.loads((out / "report.json").read_text())["stages"]
    peaks = ", ".join(f"{name} {cost['peak_memory_bytes'] / 1e9:.2f}" for name, cost in stages.items())
    lines = [
        "| photos | size | preset | limit GB | exit code | s | peak GB | predicted GB | off by | peak by stage, GB |",
        "|---|---|---|---|---|---|---|---|---|---|",
        f"| {options.photos} | {width} x {height} | {options.preset} | {options.limit_gb:g} | {code} | {seconds:.0f} "
        f"| {peak / 1e9:.2f} | {predicted / 1e9:.2f} | {off:+.0%} | {peaks} |",
    ]
    text = "\n".join(lines) + "\n"
    print(text)
    if options.table:
        options.table.write_text(text)
    shutil.rmtree(work)
    return int(code != 0 or not abs(off) <= MOST_OFF)


if __name__ == "__main__":
    sys.exit(main())
