"""Start the node with a file of parameters: ros2 launch thinkgrasp_ros thinkgrasp.launch.py params_file:=FILE"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def generate_launch_description() -> LaunchDescription:
    """Return the node and its arguments."""
    default = Path(get_package_share_directory("thinkgrasp_ros")) / "config" / "thinkgrasp.yaml"
    return LaunchDescription(
        [
            DeclareLaunchArgument("params_file", default_value=str(default), description="Parameters of the node."),
            DeclareLaunchArgument("log_level", default_value="info", description="debug, info, warn or error."),
            Node(
                package="thinkgrasp_ros",
                executable="thinkgrasp_node",
                name="thinkgrasp",
                output="screen",
                parameters=[LaunchConfiguration("params_file")],
                arguments=["--ros-args", "--log-level", LaunchConfiguration("log_level")],
            ),
        ]
    )
