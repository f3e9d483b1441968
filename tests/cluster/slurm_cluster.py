"""A Slurm cluster on one machine: Debian's slurmctld and slurmd, each in a network namespace and under a host name of its own.

Nothing leaves the machine: the namespaces are joined by a bridge that has no way out. Needs root, and Debian's packages slurm-wlm and
munge. Every process belongs to one of the namespaces, and only those are killed.
"""

import os
import pathlib
import shutil
import signal
import stat
import subprocess
import tempfile
import time

CONTROL = "control"
ADDRESS = "10.213.0."


def wait_for(what, answer, seconds=120):
    """Asks again and again until there is an answer."""
    end = time.monotonic() + seconds
    while True:
        found = answer()
        if found:
            return found
        if time.monotonic() > end:
            raise TimeoutError(f"waited {seconds} s until {what}")
        time.sleep(0.1)


class Cluster:
    """`nodes` nodes with `cpus` processors and `gpus` placeholders of GPUs each, and a folder that all of them see."""

    def __init__(self, nodes=3, cpus=2, gpus=1):
        self.names = [f"n{number}" for number in range(1, nodes + 1)]
        self.cpus, self.gpus = cpus, gpus
        self.folder = pathlib.Path(tempfile.mkdtemp(prefix="eddy_slurm_"))
        # Namespaces have names for the whole machine.
        self.prefix = f"eddy{os.getpid()}"
        self.processes = []

    def __enter__(self):
        try:
            self.connect()
            self.configure()
            munged = ["munged", "--foreground", "--force", f"--key-file={self.folder}/munge.key"]
            files = [("socket", "munge.socket"), ("pid-file", "munged.pid"), ("log-file", "munged.log"), ("seed-file", "munge.seed")]
            self.start(CONTROL, munged + [f"--{option}={self.folder}/{name}" for option, name in files], "munged")
            wait_for("munged listens", (self.folder / "munge.socket").exists)
            self.start(CONTROL, ["slurmctld", "-D", "-f", str(self.folder / "slurm.conf")], "slurmctld")
            for name in self.names:
                self.start_node(name)
            wait_for("all nodes are idle", lambda: self.states() == {name: "idle" for name in self.names}, 30)
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_):
        for name in [*self.names, CONTROL]:
            self.kill_all(name)
            subprocess.run(["ip", "netns", "del", self.space(name)], stderr=subprocess.DEVNULL)
        for process in self.processes:
            process.wait()
        shutil.rmtree(self.folder, ignore_errors=True)

    def space(self, name):
        return f"{self.prefix}{name}"

    def connect(self):
        """One namespace with a bridge, and one per node with a cable to it."""

        def ip(*words):
            subprocess.run(["ip", *words], check=True)

        ip("netns", "add", self.space(CONTROL))
        ip("-n", self.space(CONTROL), "link", "add", "bridge", "type", "bridge")
        ip("-n", self.space(CONTROL), "addr", "add", f"{ADDRESS}1/24", "dev", "bridge")
        for device in ["lo", "bridge"]:
            ip("-n", self.space(CONTROL), "link", "set", device, "up")
        for number, name in enumerate(self.names):
            ip("netns", "add", self.space(name))
            ip("-n", self.space(name), "link", "add", "cable", "type", "veth", "peer", "name", name, "netns", self.space(CONTROL))
            ip("-n", self.space(name), "addr", "add", f"{ADDRESS}{11 + number}/24", "dev", "cable")
            for device in ["lo", "cable"]:
                ip("-n", self.space(name), "link", "set", device, "up")
            ip("-n", self.space(CONTROL), "link", "set", name, "master", "bridge", "up")

    def configure(self):
        folder = self.folder
        folder.chmod(0o755)
        key = folder / "munge.key"
        key.write_bytes(os.urandom(128))
        key.chmod(0o400)
        (folder / "state").mkdir()
        gpus = [f"{folder}/{name}_gpu{number}" for name in self.names for number in range(self.gpus)]
        for file in gpus:
            # Slurm accepts device files only; this is that of /dev/null.
            os.mknod(file, stat.S_IFCHR | 0o666, os.makedev(1, 3))
        gres = f"Gres=gpu:{self.gpus} " if self.gpus else ""
        nodes = [
            f"NodeName={name} NodeAddr={ADDRESS}{11 + number} CPUs={self.cpus} RealMemory=8000 {gres}State=UNKNOWN"
            for number, name in enumerate(self.names)
        ]
        settings = f"""
ClusterName=eddy
SlurmctldHost={CONTROL}({ADDRESS}1)
SlurmUser=root
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket,cred_expire=5
SlurmctldPort=16817
SlurmdPort=16818
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool.%n
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.%n.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.%n.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
MpiDefault=none
SchedulerType=sched/backfill
SchedulerParameters=batch_sched_delay=1,sched_interval=5,bf_interval=2,requeue_delay=1
SelectType=select/cons_tres
SelectTypeParameters=CR_Core_Memory
GresTypes=gpu
SlurmdParameters=config_overrides
ReturnToService=2
SlurmdTimeout=10
KillWait=5
MinJobAge=300
{chr(10).join(nodes)}
PartitionName=main Nodes=ALL Default=YES MaxTime=INFINITE State=UP
"""
        (folder / "slurm.conf").write_text(settings.lstrip())
        names = [f"NodeName={name} Name=gpu File={folder}/{name}_gpu[0-{self.gpus - 1}]\n" for name in self.names]
        (folder / "gres.conf").write_text("".join(names) if self.gpus else "")
        # Settings for sbatch, squeue and others.
        self.environment = {**os.environ, "SLURM_CONF": str(folder / "slurm.conf")}

    def within(self, name, words):
        """A command in the namespaces of a node."""
        return ["nsenter", f"--net=/run/netns/{self.space(name)}", "unshare", "--uts", "sh", "-c", f'hostname {name} && exec "$@"', "sh", *words]

    def start(self, name, words, log):
        with open(self.folder / f"{log}.out", "ab") as output:
            process = subprocess.Popen(
                self.within(name, words), env=self.environment, stdout=output, stderr=output, stdin=subprocess.DEVNULL, start_new_session=True
            )
        self.processes.append(process)

    def start_node(self, name):
        self.start(name, ["slurmd", "-D", "-N", name, "-f", str(self.folder / "slurm.conf")], f"slurmd.{name}")

    def pids(self, name):
        """The processes of a node."""
        found = subprocess.run(["ip", "netns", "pids", self.space(name)], capture_output=True, text=True)
        return [int(word) for word in found.stdout.split()]

    def kill_all(self, name):
        """Ends all processes of a node without notice, as a power failure does."""
        while pids := self.pids(name):
            for pid in pids:
                try:
                    os.kill(pid, signal.SIGKILL)
                except ProcessLookupError:
                    pass
            time.sleep(0.05)

    def run(self, *words, **options):
        """Runs a command of Slurm and returns what it prints."""
        done = subprocess.run(self.within(CONTROL, words), env=self.environment, capture_output=True, text=True, **options)
        if done.returncode:
            raise RuntimeError(f"{words}: {done.stdout}{done.stderr}")
        return done.stdout

    def states(self):
        """The state of each node."""
        try:
            lines = self.run("sinfo", "--noheader", "--Node", "--format=%N %t").splitlines()
        except RuntimeError:
            return {}
        return dict(line.split() for line in lines)

    def jobs(self):
        """Jobs that have not ended: (id, state, node) for each task of an array."""
        lines = self.run("squeue", "--noheader", "--array", "--format=%i %t %N").splitlines()
        return [(words + [""])[:3] for words in (line.split() for line in lines)]
