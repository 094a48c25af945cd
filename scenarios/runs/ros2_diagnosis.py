"""Why a ROS 2 node gives no command, as far as the nodes around a run and their messages show."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Set
from typing import Final

from bridge.ros2 import messages
from bridge.ros2.commands import COMMAND_TYPES, hash_fault
from bridge.ros2.node import Ros2Node
from bridge.ros2.wire import Endpoint, full_topic, type_hash
from cosim.spec.ros2 import CMD_VEL, PUBLISHED_TOPICS, TOPIC_OPTIONS, Ros2Distro, Ros2Settings

_MAX_NAMED: Final = 8
"""Largest number of nodes or topics that a message names."""


def diagnosis(
    node: Ros2Node, settings: Ros2Settings, faults: Iterable[str], sent: Set[str] = frozenset()
) -> str:
    """Return why there is no command, "" if nothing is wrong with the nodes around.

    faults: Of messages, in words.
    sent: Topics of the messages of the episode.
    """
    there = node.others
    runs = {
        end.session for end in there if end.kind == "MP" and end.topic.endswith(messages.EPISODE)
    }
    others = [end for end in there if end.session not in runs]
    found = [
        *faults,
        *_faults_of_publishers(others, settings),
        *_faults_of_subscriptions(node, settings.distro),
        *_silent_topics(node, sent),
    ]
    if found:
        return "; ".join(dict.fromkeys(found))
    if not others:
        return (
            f"no ROS 2 node is at {settings.where} in any domain: nodes of rmw_zenoh connect "
            "there, a pyzeros node needs a configuration with the mode client and this endpoint, "
            "and those on DDS need zenoh-bridge-ros2dds and --ros2-dialect ros2dds"
        )
    publishers = node.publishers_of(CMD_VEL).values()
    here = full_topic(settings.namespace, CMD_VEL)
    if not publishers:
        names = ", ".join(sorted({end.in_words for end in others})[:_MAX_NAMED])
        return f"none of the nodes {names} publishes {here} in domain {settings.domain}"
    if settings.wait != "rate" and not node.subscriptions():
        return _reads_nothing(next(iter(publishers)), others)
    return ""


def _faults_of_publishers(others: Iterable[Endpoint], settings: Ros2Settings) -> Iterator[str]:
    """Yield why publishers of commands do not drive."""
    here = full_topic(settings.namespace, CMD_VEL)
    for end in others:
        if end.kind != "MP" or not end.topic.endswith(CMD_VEL):
            continue
        if end.domain not in (-1, settings.domain):
            yield (
                f"{end.in_words} publishes {end.topic} in domain {end.domain}, and this episode is "
                f"in domain {settings.domain}: set ROS_DOMAIN_ID={settings.domain} or --ros2-domain"
            )
        elif end.topic != here:
            yield f"{end.in_words} publishes {end.topic}, not {here}: remap it"
        elif words := unreadable(end, settings.distro):
            yield words


def unreadable(end: Endpoint, distro: Ros2Distro) -> str:
    """Return why the commands of a publisher cannot be read, "" if they can."""
    if end.type not in COMMAND_TYPES:
        types = " or ".join(COMMAND_TYPES)
        return f"{end.in_words} publishes {CMD_VEL} as {end.type}: publish {types}"
    return _fault_of_hash(end, distro)


def _faults_of_subscriptions(node: Ros2Node, distro: Ros2Distro) -> Iterator[str]:
    """Yield why subscriptions to topics of the run get no message."""
    for topic, end in node.subscriptions():
        if end.type != (published := PUBLISHED_TOPICS[topic]):
            yield f"{end.in_words} subscribes to {end.topic} as {end.type}, it is {published}"
        elif words := _fault_of_hash(end, distro):
            yield words


def _silent_topics(node: Ros2Node, sent: Set[str]) -> Iterator[str]:
    """Yield the subscriptions to topics without messages, if nothing else is read."""
    read = node.subscriptions()
    if sent and not any(topic in sent for topic, _ in read):
        for topic, end in read:
            if topic in TOPIC_OPTIONS:
                nothing = f"subscribes to {end.topic}, and this run sends nothing there"
                yield f"{end.in_words} {nothing}: see {TOPIC_OPTIONS[topic]}"


def _fault_of_hash(end: Endpoint, distro: Ros2Distro) -> str:
    """Return the remedy for an entity with a type hash of another distribution, "" if it fits."""
    wanted = type_hash(end.type, distro)
    if end.hash in ("", wanted):
        return ""
    return f"{end.in_words} {hash_fault(end.type, end.hash, wanted)}"


def _reads_nothing(publisher: Endpoint, others: Iterable[Endpoint]) -> str:
    """Describe a publisher of commands that subscribes to no topic of the run."""
    topics = {
        end.topic for end in others if end.kind == "MS" and end.in_words == publisher.in_words
    }
    read = ", ".join(sorted(topics)[:_MAX_NAMED])
    only = f"only to {read}, and the run publishes none of these" if read else "to no topic"
    return f"{publisher.in_words} publishes {CMD_VEL} and subscribes {only}"


def two_publishers(one: Endpoint, other: Endpoint) -> str:
    """Name two publishers of commands, with a remedy."""
    names = one.in_words, other.in_words
    if names[0] == names[1]:
        names = (f"{names[0]} of session {one.session[:8]}", f"of session {other.session[:8]}")
    return (
        f"two publishers of {CMD_VEL}, {names[0]} and {names[1]}: stop one, or mix their commands "
        "in a node of your own"
    )
