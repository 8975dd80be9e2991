"""The memory that a run will take is said beforehand, and is what such runs took."""

import pytest

from reconstruct import memory
from reconstruct.memory import memory_sentence, predicted_memory

# photos, their size, preset, bytes at the peak: runs of benchmarks/soak/large.py and of examples/spot on two cores
MEASURED = [
    (36, 1008, 756, "standard", 2.43e9),
    (36, 1008, 756, "draft", 1.18e9),
    (24, 800, 600, "standard", 2.05e9),
    (18, 800, 600, "standard", 1.94e9),
    (40, 200, 200, "standard", 0.93e9),
    (40, 512, 512, "draft", 1.14e9),
    (40, 4000, 3000, "draft", 1.97e9),
]


@pytest.mark.parametrize("run", MEASURED)
def test_the_prediction_is_within_a_fifth_of_what_was_measured(run):
    *what, measured = run
    assert predicted_memory(*what) == pytest.approx(measured, rel=0.2)


def test_more_photos_and_finer_presets_need_more():
    assert predicted_memory(300, 4032, 3024, "draft") < predicted_memory(300, 4032, 3024, "standard")
    assert predicted_memory(36, 4032, 3024, "standard") > predicted_memory(20, 4032, 3024, "standard")


def test_a_machine_with_too_little_is_told_what_would_do(monkeypatch):
    class Little:
        available = 6e9

    monkeypatch.setattr(memory.psutil, "virtual_memory", lambda: Little)
    assert "6.00 GB are free: this machine may run out of it; --preset draft would do" in memory_sentence(
        300, 4032, 3024, "standard"
    )
    assert memory_sentence(36, 1008, 756, "draft").endswith("6.00 GB are free")
