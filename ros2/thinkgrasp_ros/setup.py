"""Build of the ament_python package; the Python package `thinkgrasp` itself comes from pip, see docs/ros2.md."""

from setuptools import setup

NAME = "thinkgrasp_ros"

setup(
    name=NAME,
    version="0.1.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/thinkgrasp.launch.py"]),
        (f"share/{NAME}/config", ["config/thinkgrasp.yaml", "config/ompl_rrtstar.yaml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    maintainer="The ThinkGrasp authors",
    maintainer_email="thinkgrasp@example.org",
    description="ThinkGrasp as a ROS 2 node.",
    license="Apache-2.0",
    entry_points={"console_scripts": [f"thinkgrasp_node = {NAME}.node:main"]},
)
