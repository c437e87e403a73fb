"""Training on a Ray cluster of two nodes on this machine."""

import os
import re
import signal
import subprocess
import sys
import threading

import pytest

pytest.importorskip("torch")
pytest.importorskip("ray")

from ray.cluster_utils import Cluster
from test_examples import EXAMPLES, environment

# the driver uses the loopback interface, and a cluster of this test needs no token
VARIABLES = {"RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0", "RAY_AUTH_MODE": "disabled", "RAY_USAGE_STATS_ENABLED": "0"}


def start_cluster():
    node = {"num_cpus": 1, "object_store_memory": 100 * 2**20, "node_ip_address": "127.0.0.1"}
    cluster = Cluster(initialize_head=True, head_node_args={**node, "include_dashboard": False})
    cluster.add_node(**node)
    cluster.wait_for_nodes()
    return cluster


@pytest.fixture
def cluster(monkeypatch):
    """Two nodes on the loopback interface, each with one CPU for an actor."""
    for name, value in {**VARIABLES, **environment()}.items():
        monkeypatch.setenv(name, value)
    cluster = start_cluster()
    yield cluster
    cluster.shutdown()


def test_training_goes_on_when_a_worker_is_killed(cluster):
    command = [sys.executable, str(EXAMPLES / "ray_hover.py"), "--address", cluster.address, "--workers", "2"]
    command += ["--envs", "32", "--iterations", "16"]
    training = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    # a training that hangs ends the test
    timer = threading.Timer(240, training.kill)
    timer.start()
    places, again, iterations, output = {}, {}, [], []
    try:
        for line in training.stdout:
            output.append(line)
            if worker := re.match(r"worker (\d) (starts|again): pid (\d+) on node (\w+)", line):
                (places if worker[2] == "starts" else again)[worker[1]] = (int(worker[3]), worker[4])
            if iteration := re.match(r"iteration (\d+): ([\d,]+) steps", line):
                iterations.append(int(iteration[1]))
                if iterations[-1] == 5:
                    os.kill(places["0"][0], signal.SIGKILL)
        code = training.wait()
    finally:
        timer.cancel()
        training.kill()
    assert code == 0, "".join(output)
    assert iterations == list(range(1, 17))
    # a worker on each node, and another process for the one that was killed
    assert len({node for _, node in places.values()}) == 2
    assert list(again) == ["0"] and again["0"][0] != places["0"][0]
