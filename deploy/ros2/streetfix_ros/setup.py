"""Package of the bridge for colcon (ament_python)."""

from setuptools import setup

NAME = "streetfix_ros"

setup(
    name=NAME,
    version="0.1.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/streetfix.launch.py"]),
        (f"share/{NAME}/config", ["config/streetfix.yaml"]),
    ],
    install_requires=["setuptools", "streetfix[server]"],
    zip_safe=True,
    maintainer="The Streetfix developers",
    maintainer_email="streetfix@example.com",
    description="Publishes the pose of a robot in a LiDAR map, from one RGB and one depth image.",
    license="Apache-2.0",
    entry_points={"console_scripts": [f"bridge = {NAME}.bridge:main"]},
)
