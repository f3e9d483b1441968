#!/usr/bin/env python3
"""Runs the tasks of a plan that are not done on a Ray cluster: ray_run.py PLAN [--address ADDRESS] [--eddy-lab PROGRAM] [--restarts N].

The plan and its data are on a file system that all nodes see; eddy-lab is in the PATH there, or --eddy-lab says where. Needs `pip install ray`. A
task that fails, or whose worker or node is lost, is started again up to N times; tasks that need its outputs are not run if it fails
for good. Run the script again for what is left.
"""

import argparse
import ctypes
import json
import os
import signal
import subprocess
import sys

import ray

PR_SET_PDEATHSIG = 1


def die_with_worker():
    """A worker that is killed takes its task with it: the next one could not start while the old one runs."""
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)


@ray.remote
def run_task(eddy_lab, plan, number, *after):
    """Runs a task. Ray waits for `after`, the tasks whose outputs it reads."""
    command = [eddy_lab, "plan", "run", plan, "--task", str(number)]
    done = subprocess.run(command, capture_output=True, text=True, preexec_fn=die_with_worker)
    if done.returncode:
        raise RuntimeError(done.stderr.strip() or f"task {number}: ended with {done.returncode}")
    return done.stdout.strip()


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("plan")
    parser.add_argument("--address", help="address of the cluster [default: that of RAY_ADDRESS, else a new one on this machine]")
    parser.add_argument("--eddy-lab", default="eddy-lab")
    parser.add_argument("--restarts", type=int, default=3, help="how often a task is started again [default: 3]")
    options = parser.parse_args()
    plan = os.path.abspath(options.plan)
    listed = subprocess.run([options.eddy_lab, "plan", "list", plan, "--json"], check=True, capture_output=True, text=True)
    tasks = json.loads(listed.stdout)
    ray.init(address=options.address, log_to_driver=False)
    results = {}
    # Tasks come after those whose outputs they read.
    for task in tasks:
        if task["state"] == "done":
            continue
        needs = {"num_cpus": task["cores"], "num_gpus": task["gpus"], "memory": task["memory"] << 20}
        again = {"max_retries": options.restarts, "retry_exceptions": True}
        after = [results[number] for number in task["after"] if number in results]
        name = task["name"]
        results[task["task"]] = run_task.options(name=name, **needs, **again).remote(options.eddy_lab, plan, task["task"], *after)
    failed = 0
    for number, result in results.items():
        try:
            print(ray.get(result), flush=True)
        except ray.exceptions.RayError as error:
            failed += 1
            print(f"task {number}: {error}", file=sys.stderr, flush=True)
    if failed:
        sys.exit(f"{failed} of {len(tasks)} tasks are not done; run the same command again to resume")


if __name__ == "__main__":
    main()
