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
            timeout --signal=KILL 0.3 "{lab}" "$@"
            echo "this attempt was made to fail" >&2
            exit 1
        fi
        ;;
esac
exec "{lab}" "$@"
"""


# Notes on which node a task begins and ends, and which GPUs it may use.
NOTING = """#!/bin/sh
case "$*" in
    "plan run "*)
        echo "begin $(hostname) ${{CUDA_VISIBLE_DEVICES:-none}} $5" >>"{folder}/notes"
        "{lab}" "$@"
        code=$?
        echo "end $(hostname) ${{CUDA_VISIBLE_DEVICES:-none}} $5" >>"{folder}/notes"
        exit $code
        ;;
esac
exec "{lab}" "$@"
"""
# A study of seconds.
STUDY = """
seeds = [1, 2]
cores = ["mingru", "mlp"]
step_frames = [2]
[data]
presets = ["fluid"]
scenes = 4
duration = 0.8
[training]
epochs = 1
"""


class Job:
    """The plan of a command in a temporary folder, and what the command makes in one process."""

    def __init__(self, eddy, command, words, files=()):
        self.temporary = tempfile.TemporaryDirectory(prefix="eddy_plan_")
        self.folder = pathlib.Path(self.temporary.name)
        self.folder.chmod(0o755)
        eddy = pathlib.Path(eddy).resolve()
        self.lab = eddy.with_name("eddy-lab")
        for name, text in files:
            (self.folder / name).write_text(text)
        self.call(eddy if command == "simulate" else self.lab, command, *words, "--output", "alone")
        self.expected = contents(self.folder / "alone")
        self.plan = self.folder / "plan.json"
        self.call(self.lab, "plan", command, str(self.plan), *words, "--output", "data")

    @classmethod
    def scenes(cls, eddy, count, duration=4.0):
        """Scenes to simulate."""
        return cls(eddy, "simulate", ["--preset", "kinds", "--scenes", str(count), "--seed", "1", "--duration", str(duration)])

    @classmethod
    def study(cls, eddy):
        """Scenes, four networks, their evaluation, times, a report."""
        return cls(eddy, "study", ["cores", "--quick", "--config", "study.toml"], [("study.toml", STUDY)])

    def call(self, program, *words):
        subprocess.run([program, "--quiet", *words], cwd=self.folder, check=True, stdout=subprocess.DEVNULL)

    def script(self, name, text):
        file = self.folder / name
        file.write_text(text.format(folder=self.folder, lab=self.lab))
        file.chmod(0o755)
        return file

    def flaky(self):
        """A program that fails twice in one task."""
        return self.script("flaky", FLAKY)

    def noting(self):
        """A program that writes down where tasks begin and end: `notes`."""
        return self.script("noting", NOTING)

    def notes(self):
        """(begin or end, node, its GPUs, task)."""
        return [line.split() for line in (self.folder / "notes").read_text().splitlines()]

    def need_gpus(self):
        """Lets every scene need a GPU, as with `--device cuda`; the tasks run without."""
        plan = json.loads(self.plan.read_text())
        for task in plan["tasks"]:
            task["cost"]["gpus"] = int("scenes" in task["work"])
        self.plan.write_text(json.dumps(plan))

    def states(self):
        listed = subprocess.run([self.lab, "plan", "list", str(self.plan), "--json"], check=True, capture_output=True, text=True)
        return json.loads(listed.stdout)

    def done(self):
        return sum(task["state"] == "done" for task in self.states())

    def is_done(self):
        return all(task["state"] == "done" for task in self.states())

    def check(self):
        """All tasks are done, and the results are those of one process, byte for byte."""
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
                if len(words) > 5 and words[:4] == [str(self.lab), "plan", "run", str(self.plan)]:
                    found.append((int(entry.name), words[5]))
        return found


def contents(folder):
    """Bags, manifests, weights and their errors by epoch, with their digests; other files have times in them."""
    files = [file for pattern in ["*.mcap", "manifest.json", "*.safetensors", "metrics.csv"] for file in folder.rglob(pattern)]
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
    print(f"{engine}: {len(killed)} kills ({kinds}), {len(job.states())} tasks, none lost, data equal byte for byte, {time.monotonic() - began:.0f} s")
