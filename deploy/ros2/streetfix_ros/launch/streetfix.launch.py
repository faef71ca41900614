"""Start the bridge of Streetfix: ``ros2 launch streetfix_ros streetfix.launch.py base_frame:=base_footprint``.

Parameters come from ``params_file``. Each parameter is also an argument, and an argument overrides the file.
"""

from pathlib import Path
from typing import Any

import yaml
from ament_index_python.packages import get_package_share_directory
from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

PACKAGE = "streetfix_ros"


def generate_launch_description() -> LaunchDescription:
    """Declare an argument for each parameter of the package's file, and start the node."""
    file = Path(get_package_share_directory(PACKAGE)) / "config" / "streetfix.yaml"
    defaults: dict[str, Any] = yaml.safe_load(file.read_text())["/**"]["ros__parameters"]
    arguments = [
        DeclareLaunchArgument("params_file", default_value=str(file), description="Parameter file of the node."),
        DeclareLaunchArgument("namespace", default_value="", description="Namespace of the node."),
        DeclareLaunchArgument("log_level", default_value="info", description="debug, info, warn, error or fatal."),
        *(
            DeclareLaunchArgument(
                name,
                default_value="",
                description=f"Overrides {name} of params_file. The package's file says {value!r}.",
            )
            for name, value in defaults.items()
        ),
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=start, args=[defaults])])


def start(context: LaunchContext, defaults: dict[str, Any]) -> list[Node]:
    """Return the node with the arguments of the launch.

    Args:
        context: of the launch, with the arguments.
        defaults: of the parameters, which give the types.
    """
    given = {name: LaunchConfiguration(name).perform(context) for name in defaults}
    overrides = {name: value_of(name, text, defaults[name]) for name, text in given.items() if text}
    return [
        Node(
            package=PACKAGE,
            executable="bridge",
            name="streetfix_bridge",
            output="screen",
            namespace=LaunchConfiguration("namespace"),
            parameters=[LaunchConfiguration("params_file"), *([overrides] if overrides else [])],
            arguments=["--ros-args", "--log-level", LaunchConfiguration("log_level")],
        )
    ]


def value_of(name: str, text: str, default: Any) -> Any:
    """Convert the text of an argument to the type of its parameter.

    Args:
        name: of the argument.
        text: as given.
        default: a value of the wanted type: text, truth value, int or float.

    Raises:
        ValueError: the text is no value of that type.
    """
    if isinstance(default, str):
        return ParameterValue(text, value_type=str)  # a name such as 5 stays a text
    try:
        if isinstance(default, bool):
            return {"true": True, "false": False}[text.lower()]
        return type(default)(text)
    except (KeyError, ValueError) as error:
        kind = "true or false" if isinstance(default, bool) else f"a number such as {default}"
        raise ValueError(f"{name}:={text} is not {kind}; the package's file says {default}") from error
