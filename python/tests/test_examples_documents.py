"""The programs in the guides and the notebook."""

import os
import re
import subprocess
import sys

import pytest
from test_examples import EXAMPLES, environment

ROOT = EXAMPLES.parents[1]


def blocks(name, language):
    """Returns the blocks of code of a guide."""
    text = (ROOT / "docs" / name).read_text()
    return re.findall(rf"^```{language}\n(.*?)^```$", text, re.M | re.S)


PROGRAMS = [
    (name, i)
    for name in ("python.md", "many-machines.md", "porting.md")
    for i, program in enumerate(blocks(name, "python"))
    if "mujoco_drones_gym" in program
]


@pytest.mark.parametrize(("name", "index"), PROGRAMS)
def test_a_program_of_a_guide(name, index, request):
    program = blocks(name, "python")[index]
    variables = environment()
    if 'render_mode="human"' in program:
        variables["DISPLAY"] = request.getfixturevalue("display")["DISPLAY"]
    for module in ("stable_baselines3", "pettingzoo"):
        if module in program or (module == "pettingzoo" and "parallel_env" in program):
            pytest.importorskip(module)
    command = [sys.executable, "-W", "error::UserWarning", "-c", program]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, cwd=ROOT, env=variables, check=False)
    assert done.returncode == 0, done.stderr


def test_job_files():
    yaml = pytest.importorskip("yaml")
    (job,) = blocks("many-machines.md", "yaml")
    job = yaml.safe_load(job)
    assert job["spec"]["completionMode"] == "Indexed"
    (arguments,) = job["spec"]["template"]["spec"]["containers"][0]["args"]
    shards = set()
    for index in range(job["spec"]["completions"]):
        # the shell replaces the program by `echo`
        text = arguments.replace("exec aviary", "exec echo")
        environment = {**os.environ, "JOB_COMPLETION_INDEX": str(index)}
        done = subprocess.run(["/bin/sh", "-c", text], capture_output=True, text=True, env=environment, check=True)
        shards.add(re.search(r"--shard (\d+/\d+) --out /data/part\d+$", done.stdout)[1])
    assert shards == {f"{part}/16" for part in range(1, 17)}
    script = next(text for text in blocks("many-machines.md", "bash") if text.startswith("#!/bin/bash"))
    text = re.sub(r"srun aviary", "echo", script)
    environment = {**os.environ, "SLURM_ARRAY_TASK_ID": "7", "SLURM_SUBMIT_DIR": "/home"}
    done = subprocess.run(["bash", "-c", text], capture_output=True, text=True, env=environment, check=True)
    assert done.stdout.endswith("--shard 7/16 --out /home/out/part7\n")


def test_notebook():
    nbformat = pytest.importorskip("nbformat")
    nbclient = pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    pytest.importorskip("stable_baselines3")
    pytest.importorskip("matplotlib")
    notebook = nbformat.read(EXAMPLES / "getting_started.ipynb", as_version=4)
    nbformat.validate(notebook)
    (parameters,) = [cell for cell in notebook.cells if "parameters" in cell.metadata.get("tags", [])]
    assert "STEPS = " in parameters.source
    parameters.source = re.sub(r"STEPS = [\d_]+", "STEPS = 20_000", parameters.source)
    before = os.environ.get("PYTHONPATH")
    os.environ.update(environment())
    try:
        nbclient.NotebookClient(notebook, timeout=300, resources={"metadata": {"path": ROOT}}).execute()
    finally:
        os.environ.pop("PYTHONPATH")
        if before is not None:
            os.environ["PYTHONPATH"] = before
    images = [
        output for cell in notebook.cells for output in cell.get("outputs", []) if "image/png" in output.get("data", {})
    ]
    assert len(images) >= 3
