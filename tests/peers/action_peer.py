"""Record and replay what a third party sees of an action of ROS 2: feedback, status and events of its services.

    action_peer.py EDDY

1. A server of rclpy on Fast DDS, with service events, and a client carry out a goal of `test_msgs/action/Fibonacci` while
   `eddy record --all` records. rosbags reads status and events of all three services with the definitions in the bag, and the feedback.
2. `eddy replay` plays feedback and status to rclpy.

EDDY is the program. The domain is ROS_DOMAIN_ID. Prints one line of JSON; exits with 1 and a message if a check fails.
"""

import json
import os
import sys
import tempfile
from pathlib import Path

from node_peer import Peer, expect, rclpy
from action_msgs.msg import GoalStatus, GoalStatusArray
from rclpy.action import ActionClient, ActionServer
from rclpy.qos import qos_profile_action_status_default, qos_profile_system_default
from rclpy.service_introspection import ServiceIntrospectionState
from rosbags.highlevel import AnyReader
from test_msgs.action import Fibonacci

ACTION = "/fibonacci"
SERVICES = ["send_goal", "get_result", "cancel_goal"]
TOPICS = {f"{ACTION}/_action/{name}" for name in ["feedback", "status", *(f"{one}/_service_event" for one in SERVICES)]}
ORDER = 6
SEQUENCE = [0, 1, 1, 2, 3, 5]


def execute(goal):
    for count in range(1, goal.request.order + 1):
        goal.publish_feedback(Fibonacci.Feedback(sequence=SEQUENCE[:count]))
    goal.succeed()
    return Fibonacci.Result(sequence=SEQUENCE)


def carry_out(peer, client):
    """A goal to its end, and a request to cancel what has ended."""
    sent = client.send_goal_async(Fibonacci.Goal(order=ORDER))
    peer.until("the goal is accepted", sent.done)
    goal = sent.result()
    result = goal.get_result_async()
    peer.until("the result", result.done)
    expect(result.result().status == GoalStatus.STATUS_SUCCEEDED, f"{result.result()}")
    cancelled = goal.cancel_goal_async()
    peer.until("the answer to a request to cancel", cancelled.done)
    return bytes(goal.goal_id.uuid)


def record(peer, bag):
    server = ActionServer(peer.node, Fibonacci, ACTION, execute)
    client = ActionClient(peer.node, Fibonacci, ACTION)
    server.configure_introspection(
        peer.node.get_clock(), qos_profile_system_default, ServiceIntrospectionState.CONTENTS)
    recorder = peer.start("record", "--all", "--from", "dds", "--output", str(bag))
    for topic in TOPICS:
        # The client reads feedback and status.
        wanted = 2 if topic.endswith(("/feedback", "/status")) else 1
        peer.until(f"the recorder of {topic}", lambda: peer.node.count_subscribers(topic) >= wanted)
    peer.spin(1)
    goal = carry_out(peer, client)
    peer.spin(2)
    peer.end(recorder)
    client.destroy()
    server.destroy()
    return goal


def check_bag(bag, goal):
    with AnyReader([bag]) as reader:
        of = {c.topic: c for c in reader.connections if c.topic.startswith(ACTION)}
        expect(set(of) == TOPICS, f"topics: {sorted(of)}")
        store = reader.typestore

        def messages(name):
            one = of[f"{ACTION}/_action/{name}"]
            kind = one.msgtype
            # What rosbags calls types outside of a folder `msg`.
            if kind not in store.fielddefs:
                kind = kind.replace("/srv/", "/srv/msg/").replace("/action/", "/action/msg/")
            return [store.deserialize_cdr(data, kind) for _, _, data in reader.messages([one])]

        feedback, states = messages("feedback"), messages("status")
        events = {service: messages(f"{service}/_service_event") for service in SERVICES}
    expect([list(one.feedback.sequence) for one in feedback] == [SEQUENCE[:n] for n in range(1, ORDER + 1)], f"{feedback}")
    expect(all(bytes(one.goal_id.uuid) == goal for one in feedback), f"{feedback}")
    last = states[-1].status_list[-1]
    expect(last.status == GoalStatus.STATUS_SUCCEEDED and bytes(last.goal_info.goal_id.uuid) == goal, f"{last}")
    requests, responses = ({
        service: [part for event in events[service] for part in getattr(event, field)] for service in SERVICES
    } for field in ("request", "response"))
    for service in SERVICES:
        expect(len(requests[service]) == len(responses[service]) == 1, f"{service}: {events[service]}")
    expect(requests["send_goal"][0].goal.order == ORDER and responses["send_goal"][0].accepted, f"{events['send_goal']}")
    expect(list(responses["get_result"][0].result.sequence) == SEQUENCE, f"{events['get_result']}")
    expect(bytes(requests["cancel_goal"][0].goal_info.goal_id.uuid) == goal, f"{events['cancel_goal']}")
    return {"feedback": len(feedback), "status": len(states), "service events": sum(map(len, events.values()))}


def replay(peer, bag, goal):
    topics = [f"{ACTION}/_action/{name}" for name in ("feedback", "status")]
    heard = peer.received(Fibonacci.Impl.FeedbackMessage, topics[0])
    states = peer.received(GoalStatusArray, topics[1], qos_profile_action_status_default)
    peer.run("--quiet", "replay", str(bag), "--to", "dds", "--topics", *topics, "--wait-for", "1")
    whole = lambda: any(list(one.feedback.sequence) == SEQUENCE and bytes(one.goal_id.uuid) == goal for one in heard)
    peer.until("the feedback", whole)
    peer.until("the status", lambda: any(
        one.status_list[-1].status == GoalStatus.STATUS_SUCCEEDED for one in states if one.status_list))


def main():
    rclpy.init(args=[])
    with tempfile.TemporaryDirectory() as folder:
        peer = Peer(os.path.abspath(sys.argv[1]), Path(folder))
        bag = Path(folder) / "action"
        try:
            goal = record(peer, bag)
            outcome = check_bag(bag, goal)
            replay(peer, bag, goal)
        except BaseException:
            for log in Path(folder).glob("*.log"):
                print(log.name, log.read_text(), file=sys.stderr)
            raise
        finally:
            for process in peer.started:
                if process.poll() is None:
                    process.kill()
                    process.wait()
    print(json.dumps(outcome), flush=True)
    # Threads of the middleware would outlive it.
    os._exit(0)


if __name__ == "__main__":
    main()
