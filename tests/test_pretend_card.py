"""The way of --device cuda where no graphics card is: on a device that takes no tensors of the CPU."""

import subprocess
import sys
from pathlib import Path

import pytest
from torch.utils import backend_registration

CASES = Path(__file__).with_name("pretend_card_cases.py")


@pytest.mark.slow  # 130 s: fails only where a tensor is made on the wrong device
def test_a_device_of_its_own_computes_what_the_cpu_does():
    if not hasattr(backend_registration, "_setup_privateuseone_for_python_backend"):
        pytest.skip("this torch takes no devices that are written in Python")
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(CASES)]
    done = subprocess.run(command, cwd=CASES.parent.parent, capture_output=True, text=True, timeout=1800)
    assert done.returncode == 0, done.stdout[-5000:]
