"""A ROS 2 node that drives to the goal: python ros2_goal.py [ENDPOINT].

It needs no ROS installation: pip install pyzeros
"""

import asyncio
import json
import math
import sys

import asyncio_for_robotics as afor
import pyzeros
import zenoh
from pyzeros.builtin_msgs import Attachment
from ros2_pyterfaces.cyclone.all_msgs import PoseStamped, Twist, Vector3


def drive(goal):
    """Return the command for a goal in the robot's frame: x ahead, y left, in metres."""
    bearing = math.atan2(goal.pose.position.y, goal.pose.position.x)
    speed = 1.0 if abs(bearing) < 0.5 else 0.2
    return Twist(linear=Vector3(x=speed, y=0.0, z=0.0), angular=Vector3(x=0.0, y=0.0, z=bearing))


@afor.scoped
async def main():
    commands = pyzeros.Pub(Twist, "/cmd_vel")
    goals = pyzeros.Sub(PoseStamped, "/cosim/goal")
    print("connected, waiting for /cosim/goal", flush=True)
    async for goal in goals.listen_reliable():
        commands.publish(drive(goal))


print("preparing the encoder, up to a minute in a new folder", flush=True)
Attachment().serialize()  # pyzeros compiles it: before the node connects, and not in the run
config = zenoh.Config()
endpoint = sys.argv[1] if len(sys.argv) > 1 else "tcp/127.0.0.1:7447"
config.insert_json5("mode", json.dumps("client"))
config.insert_json5("connect/endpoints", json.dumps([endpoint]))
config.insert_json5("connect/timeout_ms", "-1")  # wait until the run has begun
print(f"waiting for a run at {endpoint}", flush=True)
with pyzeros.auto_context(node="goal_driver", zenoh_session=zenoh.open(config)):
    asyncio.run(main())
