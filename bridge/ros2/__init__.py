"""ROS 2 over Zenoh without a ROS installation: types, keys, messages and a node."""
