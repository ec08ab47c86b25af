"""ROS 1 systems, without ROS: a node, a master, and the ROS graph of the legacy network in front of an agent."""
