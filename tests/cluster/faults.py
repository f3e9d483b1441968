"""What the tests of all engines share: a plan, its result on this machine alone, and random kills."""

import hashlib
import json
import os
import pathlib
import random
import signal
import subprocess
import tempfile
import threading
import time

ROOT = pathlib.Path(__file__).resolve().parents[2]
FILES = ROOT / "launch_configs" / "cluster"
# Fails twice in the middle of task 3, then does its work.
FLAKY = """#!/bin/sh
case "$*" in
    "plan run "*" --task 3")
        echo attempt >>"{folder}/attempts"
        if [ "$(wc -l <"{folder}/attempts")" -le 2 ]; then
            timeout --signal=KILL 0.3 "{eddy}" "$@"
            echo "this attempt was made to fail" >&2
            exit 1
        fi
        ;;
esac
exec "{eddy}" "$@"
"""


class Job:
    """A plan of scenes in a temporary folder, and the same scenes simulated by one process."""

    def __init__(self, eddy, scenes, duration=4.0):
        self.temporary = tempfile.TemporaryDirectory(prefix="eddy_plan_")
        self.folder = pathlib.Path(self.temporary.name)
        self.folder.chmod(0o755)
        self.eddy = pathlib.Path(eddy).resolve()
        self.scenes = scenes
        words = ["--preset", "kinds", "--scenes", str(scenes), "--seed", "1", "--duration", str(duration)]
        self.call("simulate", *words, "--output", "alone")
        self.expected = contents(self.folder / "alone")
        self.plan = self.folder / "plan.json"
        self.call("plan", "simulate", str(self.plan), *words, "--output", "data")

    def call(self, *words):
        subprocess.run([self.eddy, "--quiet", *words], cwd=self.folder, check=True, stdout=subprocess.DEVNULL)

    def flaky(self):
        """A program that fails twice in one task."""
        file = self.folder / "flaky"
        file.write_text(FLAKY.format(folder=self.folder, eddy=self.eddy))
        file.chmod(0o755)
        return file

    def states(self):
        listed = subprocess.run([self.eddy, "plan", "list", str(self.plan), "--json"], check=True, capture_output=True, text=True)
        return json.loads(listed.stdout)

    def done(self):
        return sum(task["state"] == "done" for task in self.states())

    def is_done(self):
        return all(task["state"] == "done" for task in self.states())

    def check(self):
        """All tasks are done, and the data are those of one process, byte for byte."""
        states = {task["name"]: task["state"] for task in self.states() if task["state"] != "done"}
        assert not states, f"not done: {states}"
        found = contents(self.folder / "data")
        assert found == self.expected, sorted(set(found.items()) ^ set(self.expected.items()))

    def running(self):
        """The processes that run tasks of this plan: (process, number of the task)."""
        found = []
        for entry in pathlib.Path("/proc").iterdir():
            if entry.name.isdigit():
                try:
                    words = (entry / "cmdline").read_bytes().decode().split("\0")
                except OSError:
                    continue
                if len(words) > 5 and words[:4] == [str(self.eddy), "plan", "run", str(self.plan)]:
                    found.append((int(entry.name), words[5]))
        return found


def contents(folder):
    """All files of a folder with their digests."""
    files = (file for file in folder.rglob("*") if file.is_file())
    return {str(file.relative_to(folder)): hashlib.sha256(file.read_bytes()).hexdigest() for file in files}


class Killer(threading.Thread):
    """Kills processes at random times until it has killed `kills`. A kill is a function that returns what it has killed, or None."""

    def __init__(self, kills, ways, seed, pause):
        super().__init__(daemon=True)
        self.kills, self.ways, self.pause = kills, ways, pause
        self.random = random.Random(seed)
        self.killed = []
        self.stop = threading.Event()

    def run(self):
        while len(self.killed) < self.kills and not self.stop.wait(self.random.uniform(*self.pause)):
            killed = self.random.choice(self.ways)(self.random)
            if killed:
                self.killed.append(killed)


def kill_task(job):
    """A way to kill: a process that runs a task."""

    def kill(chance):
        running = job.running()
        if not running:
            return None
        process, task = chance.choice(running)
        try:
            os.kill(process, signal.SIGKILL)
        except ProcessLookupError:
            return None
        return f"task {task}"

    return kill


def summary(engine, killed, job, began):
    kinds = {}
    for what in killed:
        kind = what.split()[0]
        kinds[kind] = kinds.get(kind, 0) + 1
    kinds = ", ".join(f"{count} {kind}s" for kind, count in sorted(kinds.items()))
    print(f"{engine}: {len(killed)} kills ({kinds}), {job.scenes + 1} tasks, none lost, data equal byte for byte, {time.monotonic() - began:.0f} s")
