"""A ROS 2 node between a policy server and a robot."""
