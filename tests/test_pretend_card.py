"""The way of --device cuda where no graphics card is: on a device that takes no tensors of the CPU."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from torch.utils import backend_registration

CASES = Path(__file__).with_name("card_cases.py")


def passes_on(card: str) -> None:
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-n", "0", str(CASES)]
    where = os.environ | {"CARD": card}
    done = subprocess.run(command, cwd=CASES.parent.parent, env=where, capture_output=True, text=True, timeout=1800)
    assert done.returncode == 0, done.stdout[-5000:]


@pytest.mark.slow  # a minute: fails only where a tensor is made on the wrong device
def test_a_device_of_its_own_computes_what_the_cpu_does():
    if not hasattr(backend_registration, "_setup_privateuseone_for_python_backend"):
        pytest.skip("this torch takes no devices that are written in Python")
    passes_on("pretended")


@pytest.mark.skipif(not torch.cuda.is_available(), reason="torch sees no CUDA device")
def test_a_graphics_card_computes_what_the_cpu_does():
    passes_on("cuda")
