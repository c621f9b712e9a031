"""ThinkGrasp as a ROS 2 node. Only `node` imports ROS; the rest takes and returns messages through `interface`."""
