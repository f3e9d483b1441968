// Tests a node with Foxglove's software: the client of its protocol and its decoders of ROS 2 messages.
//
//   node check_foxglove.mjs EDDY BAG TOPIC     EDDY: the built program; BAG: frames; TOPIC: an unused prefix
//
// Replays BAG to `eddy node --foxglove` on shared memory and subscribes to every topic that it offers.

import assert from "node:assert/strict";
import { spawn } from "node:child_process";
import { setTimeout as sleep } from "node:timers/promises";
import { parse } from "@foxglove/rosmsg";
import { MessageReader } from "@foxglove/rosmsg2-serialization";
import protocol from "@foxglove/ws-protocol";
import WebSocket from "ws";

const [eddy, bag, prefix] = process.argv.slice(2);
const DEADLINE = 60_000;
const children = [];

async function until(what, answer) {
  const end = Date.now() + DEADLINE;
  for (;;) {
    const found = answer();
    if (found) return found;
    if (Date.now() > end) throw new Error(`timed out after ${DEADLINE / 1000} s: ${what}`);
    await sleep(20);
  }
}

function start(...words) {
  const child = spawn(eddy, words, { stdio: ["ignore", "pipe", "inherit"] });
  children.push(child);
  child.printed = "";
  child.stdout.on("data", (bytes) => { child.printed += bytes; });
  return child;
}

/** The positions of a cloud, read according to its fields. */
function positions({ data, fields, point_step, width, height }) {
  const view = new DataView(data.buffer, data.byteOffset, data.byteLength);
  const [x, y] = ["x", "y"].map((name) => fields.find((field) => field.name === name).offset);
  const point = (number) => [x, y].map((offset) => view.getFloat32(number * point_step + offset, true));
  return Array.from({ length: width * height }, (_, number) => point(number));
}

try {
  const link = `shm:${prefix}`;
  const node = start("node", "--input", `${link}/particles`, "--output", `${link}/prediction`, "--foxglove", "0");
  const url = await until("the node prints its URL", () => node.printed.match(/foxglove: (ws:\S+)/)?.[1]);
  start("--quiet", "replay", bag, "--to", "shm", "--remap", `/particles:=${prefix}/particles`, "--loop", "--wait-for", "1");

  // The same protocol; the SDK's server uses another name for it.
  const client = new protocol.FoxgloveClient({ ws: new WebSocket(url, ["foxglove.sdk.v1"]) });
  const topics = new Map();
  const readers = new Map();
  const last = new Map();
  const clouds = { observed: new Map(), predicted: new Map() };
  let failure;
  client.on("error", (error) => { failure = error; });
  client.on("advertise", (channels) => {
    for (const channel of channels) {
      topics.set(channel.topic, channel.schemaName);
      const reader = new MessageReader(parse(channel.schema, { ros2: true }));
      readers.set(client.subscribe(channel.id), { topic: channel.topic, reader });
    }
  });
  client.on("message", ({ subscriptionId, data }) => {
    const { topic, reader } = readers.get(subscriptionId);
    const message = reader.readMessage(data);
    last.set(topic, message);
    const kind = topic.endsWith("/particles/cloud") ? "observed" : topic.endsWith("/prediction/cloud") && "predicted";
    if (kind) clouds[kind].set(`${message.header.stamp.sec}.${message.header.stamp.nanosec}`, message);
  });

  await until("a message arrived on every topic", () => failure || (last.size === 4 && last.size === topics.size));
  assert.equal(failure, undefined);
  assert.deepEqual(Object.fromEntries(topics), {
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
    [`${prefix}/particles/cloud`]: "sensor_msgs/msg/PointCloud2",
    [`${prefix}/prediction/cloud`]: "sensor_msgs/msg/PointCloud2",
    [`${prefix}/prediction/status`]: "eddy_msgs/msg/PredictionStatus",
  });
  assert.equal(last.get("/diagnostics").status[0].name, "eddy_node");
  assert.equal(last.get(`${prefix}/prediction/status`).horizon, 1);

  const both = await until("ground truth and prediction of the same instant arrived", () =>
    [...clouds.predicted.keys()].find((stamp) => clouds.observed.has(stamp)));
  const [truth, predicted] = [clouds.observed, clouds.predicted].map((seen) => positions(seen.get(both)));
  assert.ok(truth.length > 0);
  assert.equal(predicted.length, truth.length);
  const distances = truth.map(([x, y], number) => Math.hypot(predicted[number][0] - x, predicted[number][1] - y));
  const mean = distances.reduce((sum, distance) => sum + distance, 0) / distances.length;
  assert.ok(mean < 0.01, `mean error one frame ahead: ${mean} domain lengths`);
  console.log(`Foxglove's client receives ${topics.size} topics; ${truth.length} points, mean error one frame ahead ${mean.toExponential(1)}`);
  client.close();
} finally {
  const ended = (child) => child.exitCode ?? new Promise((resolve) => child.once("exit", resolve));
  children.forEach((child) => child.kill("SIGINT"));
  await Promise.all(children.map(ended));
}
