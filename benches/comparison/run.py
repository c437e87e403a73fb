#!/usr/bin/env python3
"""Runs every measurement in turn, several rounds, one process at a time, and prints a table.

    python run.py --aviary ../../target/release/aviary --rounds 5

Rows alternate within a round (A B C, A B C), so that a slow moment of the machine hits all of them. The table has
the median over the rounds of the median of each process, and the best chunk of all rounds: on a machine with other
load, compare the best. `aviary bench` prints medians only: its best is the best median of a round.
"""

import argparse
import json
import os
import pathlib
import statistics
import subprocess
import sys
import tempfile
import time

HERE = pathlib.Path(__file__).resolve().parent
NAME = "mujoco-drones-gym"
# rows of `aviary bench --quick --json` that the table shows
AVIARY = {
    "hover alone, mujoco, mjc": f"{NAME}, 1 environment, MuJoCo engine",
    "hover alone, hybrid, mjc": f"{NAME}, 1 environment, hybrid engine",
    "hover × 4096, hybrid, mjc": f"{NAME}, 4096 environments, hybrid engine",
}
CRAZYFLOW = ["crazyflow_worlds.py", "--worlds"]


def rows():
    """Returns (group, threads, script and options) of the Python measurements."""
    yield "1", 1, ["pybullet_calls.py"]
    yield "1", 1, ["mujoco_calls.py"]
    yield "mj_step", 1, ["mujoco_calls.py", "--bare"]
    yield "1", 1, [*CRAZYFLOW, "1"]
    yield "1", 1, [*CRAZYFLOW, "1", "--steps-per-call", "100"]
    yield "1", 1, [*CRAZYFLOW, "1", "--model", "env"]
    for threads in (1, 2):
        yield "4096", threads, [*CRAZYFLOW, "4096"]
        yield "4096", threads, [*CRAZYFLOW, "4096", "--integrator", "rk4"]
        yield "4096", threads, [*CRAZYFLOW, "4096", "--model", "env"]
    yield "4096", 1, ["mujoco_calls.py", "--mjx", "4096"]


def processors(threads, options):
    return options.processors[-1] if threads == 1 else ",".join(options.processors)


def run(words, threads, options):
    """Runs a program on a number of processors and returns the lines of JSON that it prints."""
    environment = dict(os.environ, PYTHONWARNINGS="ignore", JAX_PLATFORMS="cpu", OMP_NUM_THREADS=str(threads))
    environment["JAX_COMPILATION_CACHE_DIR"] = options.cache
    if threads == 1:
        environment["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false"
    words = ["taskset", "-c", processors(threads, options), *words]
    wait(options.quiet)
    # MuJoCo writes its warnings to a file in the working directory
    result = subprocess.run(words, cwd=options.cache, env=environment, capture_output=True, text=True)
    if result.returncode:
        sys.exit(f"{' '.join(map(str, words))}: {result.stderr[-2000:]}")
    return result.stdout


def busy():
    """Returns the idle and the total time of all processors since boot."""
    fields = [int(x) for x in pathlib.Path("/proc/stat").read_text(encoding="utf-8").split("\n", 1)[0].split()[1:9]]
    return fields[3] + fields[4], sum(fields)


def wait(seconds):
    """Waits, for so many seconds at most, until other programs use less than a tenth of the processors."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        idle, total = busy()
        time.sleep(1.5)
        idle_later, total_later = busy()
        if idle_later - idle > 0.9 * (total_later - total):
            return


def bench(options, table):
    """Adds the rows of `aviary bench`."""
    for threads in (1, 2):
        found = json.loads(run([str(options.aviary), "bench", "--quick", "--json"], threads, options))
        if threads == 1:
            name = f"mj_step, scene of {NAME}, MuJoCo 2.2"
            add(table, ("mj_step", 1, name), found["mj_step_per_second"])
            print(json.dumps({"name": name, "median": found["mj_step_per_second"]}), flush=True)
        for row in found["rows"]:
            name = AVIARY.get(row["name"])
            if name and row["threads"] == threads and (threads == 1 or row["environments"] > 1):
                rate, ratio = row["env_steps_per_second"], row["ratio_to_mj_step"]
                add(table, (str(row["environments"]), threads, name), rate, ratio=ratio)
                print(json.dumps({"name": name, "threads": threads, "median": rate, "ratio": ratio}), flush=True)


def add(table, key, median, best=None, ratio=None):
    entry = table.setdefault(key, {"median": [], "best": [], "ratio": []})
    entry["median"].append(median)
    entry["best"].append(best or median)
    if ratio:
        entry["ratio"].append(ratio)


def machine():
    """Returns the processor and the SIMD instruction sets that it has."""
    cpu = {}
    for line in pathlib.Path("/proc/cpuinfo").read_text(encoding="utf-8").split("\n\n", 1)[0].splitlines():
        name, _, value = line.partition(":")
        cpu[name.strip()] = value.strip()
    sets = ", ".join(name for name in ("avx2", "avx512f") if name in cpu["flags"].split())
    family = f"family {cpu['cpu family']}, model {cpu['model']}"
    return f"{cpu['model name']} ({family}), {sets}, {os.cpu_count()} processors"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--aviary", type=pathlib.Path, help="release build of this project's program")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=3.0, help="measured time of one process")
    parser.add_argument("--processors", default="0,1", help="processors to run on; the last one for single threads")
    parser.add_argument("--quiet", type=float, default=0.0, help="longest wait before a process for an idle machine, s")
    parser.add_argument("--out", type=pathlib.Path, help="JSON file for all figures")
    options = parser.parse_args()
    options.processors = options.processors.split(",")
    if options.aviary:
        options.aviary = options.aviary.resolve()
    table = {}
    print(machine(), time.strftime("%Y-%m-%d"), flush=True)
    with tempfile.TemporaryDirectory() as options.cache:
        for round_number in range(options.rounds):
            print(f"round {round_number + 1}, load {os.getloadavg()[0]:.2f}", flush=True)
            if options.aviary:
                bench(options, table)
            for group, threads, words in rows():
                words = [sys.executable, HERE / words[0], *words[1:], "--seconds", str(options.seconds)]
                output = run(words, threads, options)
                for line in filter(lambda line: line.startswith("{"), output.splitlines()):
                    print(line, flush=True)
                    row = json.loads(line)
                    add(table, (group, threads, row["name"]), row["median"], row["best"])
    if options.out:
        found = [{"group": g, "threads": t, "name": n, **entry} for (g, t, n), entry in table.items()]
        options.out.write_text(json.dumps({"machine": machine(), "rows": found}, indent=1), encoding="utf-8")
    print("\n| group | threads | measurement | median, 1/s | best, 1/s | times `mj_step` of the run |")
    print("| --- | --- | --- | --- | --- | --- |")
    for (group, threads, name), entry in sorted(table.items(), key=lambda item: item[0][:2]):
        ratio = f"{statistics.median(entry['ratio']):.2f}" if entry["ratio"] else ""
        print(
            f"| {group} | {threads} | {name} | {statistics.median(entry['median']):,.0f} | {max(entry['best']):,.0f} "
            f"| {ratio} |"
        )


if __name__ == "__main__":
    main()
