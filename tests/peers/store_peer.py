"""Check bags in object stores: moto's server and SeaweedFS (S3), gcp-storage-emulator (Google Cloud Storage).

    store_peer.py EDDY [--time]

1. A data set in each store reads as from the disk: `bag info`, `bag check`, `predict` (equal bytes), `train` (equal weights),
   `eval` (equal curves), `replay`.
2. `simulate` into a store: the bags have the bytes of those on a disk; killed in the middle, each scene is there as a whole or not
   at all, and the same command continues; of two processes that write into one place, one ends with a sentence.
3. Faults between eddy and the store: answers 503 are repeated; an object that is removed or replaced while it is read, expired
   credentials, wrong credentials (checked by SeaweedFS), a server that is gone: one sentence each, with exit code 1.
4. The secret key is in no line that eddy prints, at its most detailed log level.

EDDY is the program, built with the feature `object-store`. --time also compares the time of an epoch with its bags read from
SeaweedFS and from the disk, several times. Prints one line of JSON; exits with 1 and a message if a check fails.
"""

import argparse
import hashlib
import http.client
import json
import logging
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from email.utils import formatdate
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import parse_qs, quote, unquote, urlsplit
from xml.sax.saxutils import escape

import boto3
from botocore.exceptions import BotoCoreError, ClientError
from gcp_storage_emulator.server import create_server
from moto.server import ThreadedMotoServer

SECRET = "a-secret-of-the-test-3f9c"
TIMEOUT = 60


def expect(holds, sentence):
    if not holds:
        sys.exit(f"store_peer.py: {sentence}")


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


class Relay(ThreadingHTTPServer):
    """Passes requests on to a server; `fault(method, path, headers)` may answer in its place with a status and a body."""

    daemon_threads = True

    def __init__(self, target, fault=None, handler=None):
        super().__init__(("127.0.0.1", 0), handler or RelayHandler)
        self.target, self.fault, self.requests = target, fault, []
        threading.Thread(target=self.serve_forever, daemon=True).start()

    @property
    def url(self):
        return f"http://127.0.0.1:{self.server_port}"


class RelayHandler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def log_message(self, *_):
        pass

    def answer(self, status, headers, body):
        self.send_response(status)
        for name, value in headers:
            if name.lower() not in ("transfer-encoding", "connection", "content-length", "date", "server"):
                self.send_header(name, value)
        length = dict((name.lower(), value) for name, value in headers).get("content-length", len(body))
        self.send_header("Content-Length", str(length if self.command == "HEAD" else len(body)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def forward(self, method, path, body, headers=None):
        host = urlsplit(self.server.target)
        connection = http.client.HTTPConnection(host.hostname, host.port, timeout=TIMEOUT)
        connection.request(method, path, body, headers if headers is not None else dict(self.headers))
        response = connection.getresponse()
        found = response.status, response.getheaders(), response.read()
        connection.close()
        return found

    def relay(self):
        body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        self.server.requests.append((self.command, self.path))
        fault = self.server.fault and self.server.fault(self.command, self.path, self.headers)
        if fault:
            status, code, message = fault
            text = f"<Error><Code>{code}</Code><Message>{message}</Message></Error>".encode()
            self.answer(status, [("Content-Type", "application/xml")], text)
        else:
            self.answer(*self.handle_request(body))

    def handle_request(self, body):
        return self.forward(self.command, self.path, body)

    do_GET = do_HEAD = do_PUT = do_POST = do_DELETE = relay


class GoogleHandler(RelayHandler):
    """The XML interface of Google Cloud Storage, as far as gcp-storage-emulator lacks it: lists, HEAD, entity tags and
    conditional PUT. Objects are stored and read by the emulator."""

    lock = threading.Lock()

    def metadata(self, bucket, key):
        status, _, body = self.forward("GET", f"/storage/v1/b/{bucket}/o/{quote(key, safe='')}", None, {})
        return json.loads(body) if status == 200 else None

    def handle_request(self, body):
        url = urlsplit(self.path)
        bucket, _, key = unquote(url.path).lstrip("/").partition("/")
        if not key:
            return self.list(bucket, parse_qs(url.query))
        if self.command == "PUT":
            with self.lock:
                return self.put(bucket, key, body)
        found = self.metadata(bucket, key)
        if found is None:
            return 404, [], b"<Error><Code>NoSuchKey</Code></Error>"
        tag, size = f'"{found["md5Hash"]}"', int(found["size"])
        if self.headers.get("If-Match", tag) != tag:
            return 412, [], b"<Error><Code>PreconditionFailed</Code></Error>"
        headers = [("ETag", tag), ("Last-Modified", formatdate(usegmt=True)), ("x-goog-generation", found["generation"])]
        if self.command == "HEAD":
            return 200, [*headers, ("Content-Length", str(size))], b""
        wanted = {"Range": self.headers["Range"]} if "Range" in self.headers else {}
        status, received, body = self.forward("GET", f"/{bucket}/{quote(key)}", None, wanted)
        ranges = [(name, value) for name, value in received if name.lower() == "content-range"]
        return status, [*headers, *ranges], body

    def put(self, bucket, key, body):
        found = self.metadata(bucket, key)
        known = self.headers.get("x-goog-if-generation-match")
        if known is not None and known != (found["generation"] if found else "0"):
            return 412, [], b"<Error><Code>PreconditionFailed</Code></Error>"
        status, _, answer = self.forward("PUT", f"/{bucket}/{quote(key)}", body, {"Content-Length": str(len(body))})
        found = self.metadata(bucket, key)
        return status, [("ETag", f'"{found["md5Hash"]}"'), ("x-goog-generation", found["generation"])], answer

    def list(self, bucket, query):
        first = lambda name: query.get(name, [""])[0]
        wanted = f"/storage/v1/b/{bucket}/o?prefix={quote(first('prefix'))}&delimiter={quote(first('delimiter'))}"
        status, _, body = self.forward("GET", wanted, None, {})
        found = json.loads(body) if status == 200 else {}
        contents = "".join(
            f"<Contents><Key>{escape(item['name'])}</Key><LastModified>{item['updated']}</LastModified>"
            f"<ETag>\"{item['md5Hash']}\"</ETag><Size>{item['size']}</Size></Contents>"
            for item in found.get("items", [])
        )
        prefixes = "".join(f"<CommonPrefixes><Prefix>{escape(prefix)}</Prefix></CommonPrefixes>" for prefix in found.get("prefixes", []))
        text = f"<ListBucketResult>{contents}{prefixes}</ListBucketResult>"
        return 200, [("Content-Type", "application/xml")], text.encode()


class Eddy:
    """Runs the program with the variables of a store; keeps all that it prints."""

    def __init__(self, program, folder):
        self.program, self.folder, self.printed = program, folder, []

    def variables(self, endpoint, secret=SECRET):
        kept = {name: value for name, value in os.environ.items() if not name.startswith(("AWS_", "GOOGLE_", "STORAGE_"))}
        kept |= {"NO_COLOR": "1", "TMPDIR": str(self.folder)}
        if endpoint is None:
            return kept
        if endpoint.startswith("gs+"):
            return kept | {"STORAGE_EMULATOR_HOST": endpoint.removeprefix("gs+")}
        return kept | {
            "AWS_ENDPOINT_URL": endpoint,
            "AWS_ALLOW_HTTP": "true",
            "AWS_REGION": "us-east-1",
            "AWS_ACCESS_KEY_ID": "tester",
            "AWS_SECRET_ACCESS_KEY": secret,
        }

    def start(self, endpoint, *arguments, secret=SECRET):
        return subprocess.Popen(
            [self.program, "--log-level", "trace", *map(str, arguments)],
            env=self.variables(endpoint, secret),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def end(self, process):
        output, errors = process.communicate(timeout=10 * TIMEOUT)
        self.printed += [output, errors]
        return process.returncode, output, errors

    def run(self, endpoint, *arguments, secret=SECRET):
        return self.end(self.start(endpoint, *arguments, secret=secret))

    def succeed(self, endpoint, *arguments):
        code, output, errors = self.run(endpoint, *arguments)
        expect(code == 0, f"{arguments}: exit code {code}: {errors[-2000:]}")
        return output

    def fail(self, endpoint, words, *arguments, secret=SECRET):
        """The command ends with 1, and its last line has these words."""
        began = time.monotonic()
        code, _, errors = self.run(endpoint, *arguments, secret=secret)
        lines = errors.strip().splitlines() or [""]
        expect(code == 1, f"{arguments}: exit code {code}, expected 1: {lines[-1]}")
        for word in words:
            expect(word in lines[-1], f"{arguments}: found `{lines[-1]}`, expected `{word}` in it")
        expect(time.monotonic() - began < TIMEOUT, f"{arguments}: took more than {TIMEOUT} s to fail")
        return lines[-1]


def s3(endpoint, secret=SECRET):
    return boto3.client(
        "s3", endpoint_url=endpoint, region_name="us-east-1", aws_access_key_id="tester", aws_secret_access_key=secret
    )


def files_of(folder):
    return sorted(path for path in folder.rglob("*") if path.is_file() and ".incomplete" not in path.parts)


def digest(data):
    return hashlib.sha256(data).hexdigest()


def reads_like_the_disk(eddy, endpoint, url, truth, name):
    """The data set `truth` is also at `url`."""
    for command in (["bag", "info", "--json"], ["bag", "check"]):
        there = eddy.succeed(endpoint, *command, f"{url}/scene_0000").replace(f"{url}/", "")
        here = eddy.succeed(None, *command, truth / "scene_0000").replace(f"{truth}/", "")
        expect(there == here, f"{name}: {command}: found {there}, expected {here}")
    bags, curves = [], []
    for place, where in (("here", truth), ("there", url)):
        output = eddy.folder / f"{name}-{place}"
        at = None if place == "here" else endpoint
        eddy.succeed(at, "predict", "--input", f"{where}/scene_0001", "--output", output)
        eddy.succeed(
            at, "train", "--data", where, "--output", eddy.folder / f"{name}-{place}-model", "--epochs", "1", "--seed", "7",
            "--config", eddy.folder / "small.toml",
        )  # fmt: skip
        bags.append([digest(file.read_bytes()) for file in sorted(output.glob("*.mcap"))])
        report = eddy.folder / f"{name}-{place}-report"
        eddy.succeed(
            at, "eval", "--checkpoint", eddy.folder / f"{name}-here-model", "--data", where, "--output", report,
            "--horizon", "20", "--starts", "2",
        )  # fmt: skip
        curves.append((report / "curves.csv").read_text())
    expect(bags[0] == bags[1], f"{name}: the predictions differ from those of the bag on the disk")
    expect(curves[0] == curves[1], f"{name}: the evaluation differs from that of the bags on the disk")
    weights = [(eddy.folder / f"{name}-{place}-model" / "model.safetensors").read_bytes() for place in ("here", "there")]
    expect(weights[0] == weights[1], f"{name}: the weights differ from those trained from the disk")
    played = eddy.succeed(endpoint, "replay", f"{url}/scene_0000", "--to", "shm", "--remap", f"/particles:=/store_{os.getpid()}/{name}", "--rate", "20")
    expect("frames" in played or "messages" in played, f"{name}: replay printed {played}")


def simulates(eddy, endpoint, url, read, name):
    """`simulate` into a store; `read(key)` is an object there, None if it does not exist."""
    request = ["simulate", "--preset", "fluid", "--scenes", "4", "--seed", "3", "--duration", "0.4", "--threads", "1"]
    here = eddy.folder / f"{name}-simulated"
    eddy.succeed(None, *request, "--output", here)
    killed = eddy.start(endpoint, *request, "--output", url)
    wait_until(lambda: read("scene_0000/metadata.yaml") or killed.poll() is not None, f"{name}: no scene appeared")
    killed.kill()
    eddy.end(killed)
    whole = 0
    for scene in range(4):
        if read(f"scene_{scene:04}/metadata.yaml"):
            whole += 1
            file = f"scene_{scene:04}/scene_{scene:04}_0.mcap"
            expect(read(file) == (here / file).read_bytes(), f"{name}: {file} differs after a kill")
    again = eddy.succeed(endpoint, *request, "--output", url)
    expect(f"{whole} of 4 scenes are already in" in again, f"{name}: found `{again}` after {whole} scenes")
    for file in files_of(here):
        key = file.relative_to(here)
        expect(read(str(key)) == file.read_bytes(), f"{name}: {key} differs from the one on a disk")
    eddy.fail(endpoint, ["seed 3 instead of 4"], *request[:5], "--seed", "4", *request[7:], "--output", url)
    return whole


def wait_until(holds, sentence):
    deadline = time.monotonic() + TIMEOUT
    while not holds():
        expect(time.monotonic() < deadline, sentence)
        time.sleep(0.02)


def two_writers(eddy, target, url):
    """The second of two processes that plan with the same manifest ends when it finds another one."""
    request = ["simulate", "--preset", "fluid", "--scenes", "2", "--seed", "5", "--duration", "0.4", "--output", url]
    held = threading.Event()

    def hold_writes(method, path, _):
        if method == "PUT" and path.endswith("manifest.json"):
            held.wait(TIMEOUT)

    relay = Relay(target, hold_writes)
    slow = eddy.start(relay.url, *request)
    wait_until(lambda: any(path.endswith("manifest.json") and method == "PUT" for method, path in relay.requests), "nothing was written")
    eddy.succeed(target, *request)
    held.set()
    code, _, errors = eddy.end(slow)
    expect(code == 1 and "another `eddy simulate` has just added scenes" in errors, f"two writers: exit code {code}: {errors[-500:]}")
    relay.shutdown()


def faults(eddy, target, client, truth, big):
    """What happens between eddy and a store."""
    url = "s3://bags/set/scene_0000"
    busy = []

    def often_busy(method, path, _):
        busy.append(path)
        if len(busy) % 3 == 0:
            return 503, "SlowDown", "Please reduce your request rate."

    relay = Relay(target, often_busy)
    output = eddy.folder / "busy"
    eddy.succeed(relay.url, "predict", "--input", url, "--output", output)
    expect(len(busy) > 3, f"found {len(busy)} requests, expected more than 3")
    relay.shutdown()

    def after_some(change):
        """Calls `change` before the fourth request for bytes of the file."""
        reads = []

        def fault(method, path, headers):
            if method == "GET" and path.endswith(".mcap"):
                reads.append(path)
                if len(reads) == 4:
                    change()

        return fault

    file = big.name + "_0.mcap"
    stored = (big / file).read_bytes()
    key = f"big/{big.name}/{file}"
    sentences = {}
    for name, change, words in [
        ("removed", lambda: client.delete_object(Bucket="bags", Key=key), [file, "does not exist in the store"]),
        ("replaced", lambda: client.put_object(Bucket="bags", Key=key, Body=stored[:-1] + b"x"), [file, "was replaced in the store"]),
    ]:
        upload(client, "bags", "big", big.parent, [big])
        relay = Relay(target, after_some(change))
        sentences[name] = eddy.fail(
            relay.url, words, "predict", "--input", f"s3://bags/big/{big.name}", "--output", eddy.folder / name
        )
        relay.shutdown()
    relay = Relay(target, lambda *_: (400, "ExpiredToken", "The provided token has expired."))
    sentences["expired"] = eddy.fail(relay.url, [url, "refused access (ExpiredToken: The provided token has expired)"], "bag", "info", url)
    relay.shutdown()
    gone = f"http://127.0.0.1:{free_port()}"
    sentences["gone"] = eddy.fail(gone, [url, "Connection refused"], "bag", "info", url)
    sentences["absent"] = eddy.fail(target, ["s3://bags/other", "does not exist in the store"], "bag", "info", "s3://bags/other")
    sentences["bucket"] = eddy.fail(target, ["s3://no-such-bucket/x"], "bag", "info", "s3://no-such-bucket/x")
    sentences["output"] = eddy.fail(target, ["expected a path of this machine"], "predict", "--input", url, "--output", "s3://bags/out")
    return sentences


def upload(client, bucket, prefix, root, folders):
    for folder in folders:
        for file in files_of(folder):
            client.upload_file(str(file), bucket, f"{prefix}/{file.relative_to(root)}")


class SeaweedFs:
    """A server that checks signatures."""

    def __init__(self, folder):
        config = folder / "s3.json"
        identity = {
            "name": "tester",
            "credentials": [{"accessKey": "tester", "secretKey": SECRET}],
            "actions": ["Admin", "Read", "Write", "List", "Tagging"],
        }
        config.write_text(json.dumps({"identities": [identity]}))
        ports = {name: free_port() for name in ("master.port", "volume.port", "filer.port", "s3.port")}
        (folder / "weed").mkdir()
        options = [f"-{name}={port}" for name, port in ports.items()]
        grpc = [f"-{name}.grpc={free_port()}" for name in ("master.port", "volume.port", "filer.port", "s3.port")]
        program = shutil.which("weed", path=str(Path(sys.executable).parent)) or "weed"
        self.url = f"http://127.0.0.1:{ports['s3.port']}"
        self.process = subprocess.Popen(
            [program, "server", f"-dir={folder / 'weed'}", "-ip=127.0.0.1", "-ip.bind=127.0.0.1", "-filer", "-s3",
             f"-s3.config={config}", "-master.volumeSizeLimitMB=64", "-volume.max=8", *options, *grpc],
            stdout=open(folder / "weed.log", "w"), stderr=subprocess.STDOUT,
        )  # fmt: skip
        client = s3(self.url)

        def ready():
            expect(self.process.poll() is None, f"weed has ended: {(folder / 'weed.log').read_text()[-1000:]}")
            try:
                client.create_bucket(Bucket="bags")
                client.put_object(Bucket="bags", Key="probe", Body=b"x")
                return True
            except (BotoCoreError, ClientError):
                return False

        wait_until(ready, "SeaweedFS did not start")

    def stop(self):
        self.process.terminate()
        self.process.wait(TIMEOUT)


def reader(client, prefix):
    def read(key):
        try:
            return client.get_object(Bucket="bags", Key=f"{prefix}/{key}")["Body"].read()
        except client.exceptions.NoSuchKey:
            return None

    return read


def epochs(eddy, endpoint, url, truth):
    """Seconds of `train` of one epoch with its bags read during training, from the store and from the disk, in turns."""
    seconds = {"store": [], "disk": []}
    for turn in range(5):
        for place, where, at in (("store", url, endpoint), ("disk", truth, None)):
            output = eddy.folder / f"epoch-{place}-{turn}"
            began = time.monotonic()
            eddy.succeed(
                at, "train", "--data", where, "--output", output, "--epochs", "1", "--seed", "7", "--memory", "0.01", "--config", eddy.folder / "small.toml"
            )
            seconds[place].append(round(time.monotonic() - began, 2))
    return seconds


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("eddy", type=Path)
    parser.add_argument("--time", action="store_true", help="compare times of an epoch")
    arguments = parser.parse_args()
    # moto's server logs every request.
    logging.getLogger("werkzeug").setLevel(logging.CRITICAL)
    results = {}
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        eddy = Eddy(arguments.eddy.resolve(), folder)
        (folder / "small.toml").write_text("[windows]\nbatch = 4\nper_epoch = 16\n")
        truth, big = folder / "set", folder / "big"
        eddy.succeed(None, "simulate", "--preset", "fluid", "--scenes", "6", "--seed", "1", "--duration", "1", "--output", truth)
        eddy.succeed(None, "simulate", "--preset", "fluid", "--scenes", "1", "--seed", "2", "--duration", "6", "--output", big)

        moto = ThreadedMotoServer("127.0.0.1", 0, verbose=False)
        moto.start()
        target = "http://{}:{}".format(*moto.get_host_and_port())
        client = s3(target)
        client.create_bucket(Bucket="bags")
        upload(client, "bags", "set", truth, [truth])
        reads_like_the_disk(eddy, target, "s3://bags/set", truth, "moto")
        results["moto"] = simulates(eddy, target, "s3://bags/new", reader(client, "new"), "moto")
        two_writers(eddy, target, "s3://bags/both")
        results["sentences"] = faults(eddy, target, client, truth, big / "scene_0000")
        moto.stop()

        weed = SeaweedFs(folder)
        client = s3(weed.url)
        upload(client, "bags", "set", truth, [truth])
        reads_like_the_disk(eddy, weed.url, "s3://bags/set", truth, "seaweedfs")
        results["seaweedfs"] = simulates(eddy, weed.url, "s3://bags/new", reader(client, "new"), "seaweedfs")
        results["sentences"]["wrong secret"] = eddy.fail(
            weed.url, ["s3://bags/set", "refused access"], "bag", "info", "s3://bags/set/scene_0000", secret="another-secret"
        )
        if arguments.time:
            # A server in Python, such as moto's, needs more of the processors than the training.
            results["seconds of an epoch"] = epochs(eddy, weed.url, "s3://bags/set", truth)
        weed.stop()

        emulator = create_server("127.0.0.1", port := free_port(), in_memory=True, default_bucket="bags")
        emulator.start()
        google = Relay(f"http://127.0.0.1:{port}", handler=GoogleHandler)
        for file in files_of(truth):
            put(google.url, f"/bags/set/{file.relative_to(truth)}", file.read_bytes())
        reads_like_the_disk(eddy, f"gs+{google.url}", "gs://bags/set", truth, "google")
        results["google"] = simulates(eddy, f"gs+{google.url}", "gs://bags/new", lambda key: get(google.url, f"/bags/new/{key}"), "google")
        google.shutdown()
        emulator.stop()

        printed = "".join(eddy.printed)
        expect(SECRET not in printed, "the secret key was printed")
        expect("another-secret" not in printed, "a wrong secret key was printed")
    print(json.dumps(results))


def request(method, url, path, body=None):
    host = urlsplit(url)
    connection = http.client.HTTPConnection(host.hostname, host.port, timeout=TIMEOUT)
    connection.request(method, quote(path), body)
    response = connection.getresponse()
    found = response.status, response.read()
    connection.close()
    return found


def put(url, path, body):
    status, answer = request("PUT", url, path, body)
    expect(status == 200, f"PUT {path}: {status} {answer}")


def get(url, path):
    status, body = request("GET", url, path)
    return body if status == 200 else None


if __name__ == "__main__":
    signal.alarm(40 * TIMEOUT)
    main()
