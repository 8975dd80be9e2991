"""Many large photos on a small machine: does the run finish under a limit of memory, and was its need predicted?

    python benchmarks/soak/large.py [--photos 300] [--megapixels 12] [--preset standard] [--limit-gb 8]
                                    [--capture FOLDER] [--table FILE]

The photos are those of examples/spot, enlarged, with fresh noise in each so that no two files are alike, and repeated
under a slope of brightness; those of the board are enlarged alike. They are kept, and used again, in --capture. The
limit is the kernel's on the private memory of the process (RLIMIT_DATA): what is taken beyond it fails. Writes a
Markdown table with the largest private memory (pages of mapped files, which the system may take back, not counted)
and what the run said of itself; exit code 1 where it fails or the prediction is off by more than a fifth.
"""

import json
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

sys.path.insert(0, str(Path(__file__).parents[1]))

from one_run import SPOT
from sheet import ROOT, Sheet, parser_of

MOST_OFF = 0.2
POLL_S = 0.1
SLOPE = 0.08  # of a repeated photo's brightness, from the middle to its border: another light, as far as ground tells
MIDDLE = 128
QUALITY = 90  # JPEG


def make_capture(folder: Path, photos: int, megapixels: float) -> None:
    """The example with so many photos of that size; repeats of a photo are lit a little otherwise, none is a copy."""
    draw = np.random.default_rng(1)
    for role in ("board", "photos"):
        (folder / role).mkdir(parents=True)
        originals = sorted((SPOT / role).iterdir())
        for number, original in enumerate(originals):
            small = cv2.imread(str(original))
            assert small is not None
            scale = (megapixels * 1e6 / (small.shape[0] * small.shape[1])) ** 0.5
            size = (round(small.shape[1] * scale), round(small.shape[0] * scale))
            large = cv2.resize(small, size, interpolation=cv2.INTER_CUBIC)
            if role == "board":
                cv2.imwrite(str(folder / role / original.name), large, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
                continue
            for repeat in range(number, photos, len(originals)):
                lit = cv2.multiply(large, _light(draw, size, repeat >= len(originals)), scale=1 / MIDDLE)
                name = f"IMG_{repeat + 1:04d}.jpg"
                cv2.imwrite(str(folder / role / name), lit, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    if (SPOT / "session.toml").exists():
        shutil.copy(SPOT / "session.toml", folder)


def _light(draw: np.random.Generator, size: tuple[int, int], is_repeat: bool) -> np.ndarray:
    """A factor times MIDDLE for each pixel: noise, and for a repeated photo a slope of brightness across it."""
    slope = draw.uniform(-SLOPE, SLOPE, 2) * is_repeat
    across, down = (np.linspace(-1, 1, n, dtype=np.float32) * s for n, s in zip(size, slope, strict=True))
    noise = draw.random((size[1], size[0]), np.float32)
    plane = (MIDDLE * (1 + across + down[:, None]) + noise).astype(np.uint8)
    return cv2.merge([plane, plane, plane])


def run_limited(capture: Path, out: Path, preset: str, limit: float) -> tuple[int, float, float]:
    """Exit code, CPU seconds and largest private resident memory, bytes, of a run under a limit in bytes."""

    def limit_memory() -> None:
        resource.setrlimit(resource.RLIMIT_DATA, (int(limit), int(limit)))

    words = [sys.executable, str(ROOT / "shadowgraph"), "run", str(capture), "--out", str(out)]
    words += ["--preset", preset, "--viewer", "off"]
    used, peak = 0.0, 0
    process = subprocess.Popen(words, cwd=ROOT, preexec_fn=limit_memory)
    watched = psutil.Process(process.pid)
    while process.poll() is None:
        try:
            held, times = watched.memory_info(), watched.cpu_times()
            peak, used = max(peak, held.rss - held.shared), times.user + times.system
        except psutil.Error:
            break
        time.sleep(POLL_S)
    return process.wait(), used, peak


def main() -> int:
    """Print the table."""
    parser = parser_of(__doc__)
    parser.add_argument("--photos", type=int, default=300)
    parser.add_argument("--megapixels", type=float, default=12.0)
    parser.add_argument("--preset", default="standard")
    parser.add_argument("--limit-gb", type=float, default=8.0)
    parser.add_argument("--capture", type=Path)
    options = parser.parse_args()
    sheet = Sheet(options.table, "seed 1 of the noise")
    work = Path(tempfile.mkdtemp(prefix="large_"))
    capture, out = options.capture or work / "capture", work / "run"
    if not capture.exists():
        make_capture(capture, options.photos, options.megapixels)
    code, seconds, peak = run_limited(capture, out, options.preset, 1e9 * options.limit_gb)
    plan = json.loads((out / "memory.json").read_text()) if (out / "memory.json").exists() else {}
    predicted, stages = plan.get("predicted", float("nan")), {}
    if (out / "report.json").exists():
        stages = json.loads((out / "report.json").read_text())["stages"]
    peaks = ", ".join(f"{name} {cost['peak_memory_bytes'] / 1e9:.2f}" for name, cost in stages.items())
    off = predicted / peak - 1
    row = {"photos": options.photos, "megapixels": options.megapixels, "preset": options.preset}
    row |= {"limit GB": options.limit_gb, "exit code": code, "CPU s": seconds, "private peak GB": peak / 1e9}
    row |= {"predicted GB": predicted / 1e9, "off by": f"{off:+.0%}"}
    sheet.write([row | {"resident peak by stage, GB": peaks, "said": plan.get("sentence")}])
    shutil.rmtree(work)
    return int(code != 0 or not abs(off) <= MOST_OFF)


if __name__ == "__main__":
    sys.exit(main())
