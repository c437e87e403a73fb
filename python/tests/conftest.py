"""Fixtures of the tests."""

import subprocess
import sys

import pytest


@pytest.fixture
def run_python():
    """Returns a function that runs a program in a new Python process and fails if the program fails."""

    def run(program, **options):
        result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120, **options)
        assert result.returncode == 0, result.stderr
        return result.stdout

    return run
