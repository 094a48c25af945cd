"""A ROS 2 node that drives to /goal_pose: python ros2_goal.py [ENDPOINT].

It needs no ROS installation: pip install pyzeros
"""

import asyncio
import json
import math
import sys

import asyncio_for_robotics as afor
import pyzeros
import zenoh
from ros2_pyterfaces.cyclone.all_msgs import Odometry, PoseStamped, Twist, Vector3

goal = None


def follow(message):
    """Store the latest goal, in the frame odom."""
    global goal
    goal = message.pose.position


def drive(message):
    """Return the command for an odometry message."""
    if goal is None:
        return Twist()
    at, turn = message.pose.pose.position, message.pose.pose.orientation
    heading = 2.0 * math.atan2(turn.z, turn.w)
    bearing = math.atan2(goal.y - at.y, goal.x - at.x) - heading
    bearing = math.atan2(math.sin(bearing), math.cos(bearing))
    speed = 1.0 if abs(bearing) < 0.5 else 0.3
    return Twist(linear=Vector3(x=speed), angular=Vector3(z=bearing))


@afor.scoped
async def main():
    commands = pyzeros.Pub(Twist, "/cmd_vel")
    goals = pyzeros.Sub(PoseStamped, "/goal_pose")
    odometry = pyzeros.Sub(Odometry, "/odom")
    goals.asap_callback.append(follow)
    async for message in odometry.listen_reliable():
        commands.publish(drive(message))


config = zenoh.Config()
endpoint = sys.argv[1] if len(sys.argv) > 1 else "tcp/127.0.0.1:7447"
config.insert_json5("connect/endpoints", json.dumps([endpoint]))
config.insert_json5("scouting/multicast/enabled", "false")
with pyzeros.auto_context(node="goal_driver", zenoh_session=zenoh.open(config)):
    asyncio.run(main())
