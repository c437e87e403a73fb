"""Fixtures of the tests."""

import os
import shutil
import subprocess
import sys
from contextlib import contextmanager

import pytest


@pytest.fixture
def run_python():
    """Returns a function that runs a program in a new Python process and fails if the program fails."""

    def run(program, **options):
        result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120, **options)
        assert result.returncode == 0, result.stderr
        return result.stdout

    return run


@contextmanager
def x_server():
    """Starts an X server without a screen. Returns its process and the environment variables of its programs."""
    if shutil.which("Xvfb") is None:
        pytest.skip("needs Xvfb: apt-get install xvfb")
    reading, writing = os.pipe()
    command = ["Xvfb", "-displayfd", str(writing), "-screen", "0", "1400x900x24", "-nolisten", "tcp"]
    server = subprocess.Popen(command, stderr=subprocess.DEVNULL, pass_fds=[writing])
    os.close(writing)
    try:
        with os.fdopen(reading) as file:
            name = file.readline().strip()
        assert name, "Xvfb does not start"
        yield server, {**without_display(), "DISPLAY": f":{name}"}
    finally:
        server.kill()
        server.wait()


@pytest.fixture(scope="session")
def display():
    """Returns the environment variables of programs that open windows."""
    with x_server() as (_, variables):
        yield variables


def without_display():
    """Returns the environment variables of programs without a display."""
    names = ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET")
    return {name: value for name, value in os.environ.items() if name not in names}
