"""Read a node's metrics with the parser of Prometheus' own client.

    metrics_peer.py URL

Checks that the text is valid, that no metric or sample occurs twice, that the type of every metric is known, and that
the node has received and published frames. Prints one line of JSON; exits with 1 and a message if a check fails.
"""

import json
import sys
import time
import urllib.request

from prometheus_client.parser import text_string_to_metric_families


def expect(holds, sentence):
    if not holds:
        sys.exit(f"metrics_peer.py: {sentence}")


def read(url):
    with urllib.request.urlopen(url, timeout=10) as answer:
        kind = answer.headers["Content-Type"]
        expect(kind.startswith("text/plain; version=0.0.4"), f"found content type {kind}")
        return list(text_string_to_metric_families(answer.read().decode()))


deadline = time.monotonic() + 60
while True:
    families = read(sys.argv[1])
    samples = [sample for family in families for sample in family.samples]
    values = {sample.name: sample.value for sample in samples}
    if values.get("eddy_published_total", 0) > 0:
        break
    expect(time.monotonic() < deadline, f"no predictions: {values}")
    time.sleep(0.2)

names = [family.name for family in families]
expect(len(names) == len(set(names)), "a metric occurs twice")
keys = [(sample.name, *sorted(sample.labels.items())) for sample in samples]
expect(len(keys) == len(set(keys)), "a sample occurs twice")
for family in families:
    expect(family.type in ("counter", "gauge"), f"{family.name} is of type {family.type}")
    expect(family.documentation, f"{family.name} has no help")
    expect(family.samples, f"{family.name} has no samples")
expect(values["eddy_received_total"] >= values["eddy_published_total"] / 2, f"{values}")
expect(len(next(s for s in samples if s.name == "eddy_info").labels["model"]) == 64, "no digest")
print(json.dumps({"metrics": len(families), "samples": len(samples), "published": values["eddy_published_total"]}))
